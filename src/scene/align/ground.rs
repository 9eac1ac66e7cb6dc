//! The ground of a scene whose axes are unknown: the plane that most of the scene lies on and
//! little lies below.
//!
//! If the whole scene has no such plane, its core is searched: the half of the Gaussians that is
//! nearest to its middle, and ever smaller cores. There the ground must also surround what stands
//! on it.
//!
//! RANSAC (Fischler and Bolles 1981) over one Gaussian for each occupied cube of a grid, so that a
//! plane counts by its area and not by how densely it was captured. All lengths are relative to the
//! size of the scene: a capture has no metres yet. The random numbers have a fixed seed: the same
//! Gaussians give the same plane.

use std::collections::HashSet;

use glam::{DQuat, DVec3};

use crate::Gaussians;
use crate::random::Random;

use super::cameras::CaptureCameras;
use super::median;
use super::plane::{GroundPlane, fit};

/// How the ground is searched.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroundSearch {
    /// Up, as far as it is known: the normal of the ground is within 45 degrees of it.
    pub up: Option<DVec3>,
    /// Number of planes that are tried.
    pub hypotheses: usize,
    /// Seed of the random numbers.
    pub seed: u64,
}

/// Why there is no ground.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GroundError {
    /// Too little of the scene is visible.
    #[error(
        "{count} places of the scene are opaque; at least {least} are needed to find a plane: train the scene for longer"
    )]
    TooFew { count: usize, least: usize },
    /// No plane below the cameras has enough of the scene on it.
    #[error(
        "found no ground below the cameras: no plane has {least_percent} % of the scene near them on it; choose three \
         points of the ground in the viewer (docs/scenes.md), or train on photographs that show more of it"
    )]
    NoneBelow {
        /// Least share of what is near the cameras, in percent.
        least_percent: u32,
    },
    /// No plane has enough of the scene on it.
    #[error(
        "found no ground: no plane has {least_percent} % of the scene on it and little of it below; choose three \
         points of the ground in the viewer, or give the heights of a drive yourself (docs/scenes.md)"
    )]
    NoPlane {
        /// Least share of the scene, in percent.
        least_percent: u32,
    },
}

/// Cubes along the scene's radius.
const CUBES: f64 = 120.0;
/// Distance from the plane that counts as on it at first, as a share of the scene's radius.
const TOLERANCE: f64 = 0.01;
/// As [`TOLERANCE`], of the ground below cameras: a few photographs leave it rough.
const TOLERANCE_BELOW: f64 = 0.02;
/// How often the tolerance is halved while the plane is fitted, at most.
const REFINEMENTS: i32 = 5;
/// Share of the first round's places that a round must have: below it the tolerance is less than
/// the ground is rough.
const LEAST_SHARE: f64 = 0.2;
/// Least logit of the opacity of a Gaussian that counts: an opacity of 0.3.
const LEAST_LOGIT: f32 = -0.85;
/// A Gaussian is flat if its thinnest axis has at most this share of the middle one: `ln 0.4`.
const FLAT_LN: f32 = -0.92;
/// Least cosine between the normals of the plane and of a flat Gaussian on it.
const LEAST_COSINE: f64 = 0.8;
/// Largest number of places with which hypotheses are compared.
const COMPARED: usize = 12_000;
const LEAST_PLACES: usize = 50;
const LEAST_PERCENT: u32 = 4;
/// As [`LEAST_PERCENT`], of the ground below cameras, of which more is known.
const LEAST_PERCENT_BELOW: u32 = 2;
/// Radius of a core as a share of that of the next larger one: the pavement of an object is a small
/// part of cores that are much larger, and not in those that are smaller.
const SHRINK: f64 = 0.75;
/// Share of the scene's opaque Gaussians that a core must have.
const LEAST_CORE_SHARE: f64 = 1.0 / 16.0;
/// Cores that are searched, at most: the last one has a thousandth of the first one's radius. Size
/// alone would not end it soon, as Gaussians at one place are in each core around it.
const MOST_CORES: usize = 24;
/// Share of what stands above a plane that is its object; the rest is what stands around it.
const OBJECT_SHARE: f64 = 0.8;
/// Least share of a plane that is farther out than its object.
const BESIDE_SHARE: f64 = 0.6;
/// Most of the core's width that the object may have.
const MOST_OBJECT: f64 = 0.6;
/// Largest angle between the normal of the ground and up across the rows of photographs, in
/// degrees.
const MOST_SLOPE: f64 = 8.0;
/// As [`MOST_SLOPE`], if photographs in one direction may all be tilted to a roof.
const MOST_TILT: f64 = 26.0;

impl Default for GroundSearch {
    fn default() -> Self {
        Self { up: None, hypotheses: 3_000, seed: 1 }
    }
}

/// A visible point of the scene.
#[derive(Clone, Copy, Debug)]
struct SurfaceSample {
    at: DVec3,
    /// Unit normal of its Gaussian, if that is flat.
    normal: Option<DVec3>,
}

/// The extent of the main part of a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneExtent {
    /// Median of the opaque Gaussians' means, by axis.
    pub middle: DVec3,
    /// Median distance of them from the middle: half of the scene is nearer.
    pub radius: f64,
}

/// The extent of the main part of a scene; at the origin, with a radius of 0, if nothing is opaque.
pub fn scene_extent(gaussians: &Gaussians) -> SceneExtent {
    extent(gaussians, &opaque(gaussians))
}

fn opaque(gaussians: &Gaussians) -> Vec<usize> {
    (0..gaussians.len()).filter(|&i| gaussians.logit_opacities[i] >= LEAST_LOGIT).collect()
}

/// Finds the ground: that of the whole scene, or else that of its core. A capture of one object has
/// most of its Gaussians in the object and far behind it, so that the pavement below the object is
/// too small a part of the scene.
///
/// # Errors
/// There are too few opaque Gaussians, or no plane has enough of them on it.
pub fn find_ground(
    gaussians: &Gaussians,
    search: &GroundSearch,
) -> Result<GroundPlane, GroundError> {
    let whole = opaque(gaussians);
    let mut rule = SceneRule { up: search.up, is_core: false };
    let none = match ground_in(gaussians, &whole, search, &rule) {
        Err(error @ GroundError::NoPlane { .. }) => error,
        found => return found.map(|found| found.plane),
    };
    rule.is_core = true;
    let middle = |some: &[usize]| middle_of_small(gaussians, some);
    let found = ground_in_cores(gaussians, &whole, &middle, search, &rule);
    found.map(|found| found.plane).map_err(|_| none)
}

/// Finds the ground below the cameras that a scene was trained from: they are above it, and say
/// about where up is. A small part of the scene is enough, as of photographs of a house, and what
/// hangs below it, where no camera looked, hides it less. Of several directions that may be up, the
/// one with more of the scene on its ground is.
///
/// # Errors
/// There are too few opaque Gaussians, or no plane below the cameras has enough of them on it.
pub fn find_ground_below(
    gaussians: &Gaussians,
    cameras: &CaptureCameras,
    search: &GroundSearch,
) -> Result<GroundPlane, GroundError> {
    let whole = opaque(gaussians);
    let middle = |_: &[usize]| cameras.middle();
    let mut best: Option<FoundGround> = None;
    for &up in cameras.ups() {
        let rule = CameraRule { cameras, up };
        match ground_in_cores(gaussians, &whole, &middle, search, &rule) {
            Ok(found) if best.is_none_or(|best| found.share > best.share) => best = Some(found),
            Ok(_) | Err(GroundError::NoPlane { .. }) => {}
            Err(too_few) => return Err(too_few),
        }
    }
    let none = GroundError::NoneBelow { least_percent: LEAST_PERCENT_BELOW };
    best.map(|best| best.plane).ok_or(none)
}

/// The ground of the largest core that has one: the half of some Gaussians that is nearest to their
/// middle, and ever smaller cores of it.
fn ground_in_cores(
    gaussians: &Gaussians,
    whole: &[usize],
    middle: &dyn Fn(&[usize]) -> DVec3,
    search: &GroundSearch,
    rule: &dyn Rule,
) -> Result<FoundGround, GroundError> {
    if whole.is_empty() {
        return Err(GroundError::TooFew { count: 0, least: LEAST_PLACES });
    }
    let least = (LEAST_CORE_SHARE * whole.len() as f64).max(1.0) as usize;
    let from = middle(whole);
    let half = median(whole.iter().map(|&i| distance(gaussians, i, from)).collect());
    let mut core = Core::within(gaussians, whole, from, half);
    let mut first = None;
    for _ in 0..MOST_CORES {
        if core.gaussians.len() < least {
            break;
        }
        match ground_in(gaussians, &core.gaussians, search, rule) {
            Ok(found) => return Ok(found),
            // Nearly all of it is at one place, where the smaller cores are too.
            Err(error @ GroundError::TooFew { .. }) => return Err(first.unwrap_or(error)),
            Err(error) => {
                first = first.or(Some(error));
                let from = middle(&core.gaussians);
                core = Core::within(gaussians, &core.gaussians, from, SHRINK * core.reach);
            }
        }
    }
    Err(first.unwrap_or(GroundError::NoPlane { least_percent: rule.least_percent() }))
}

/// What makes a plane the ground.
trait Rule {
    /// The plane with its up side, by what is on it and beside it; `None` if it is not the ground.
    fn score(&self, plane: GroundPlane, beside: &Beside) -> Option<Scored>;

    /// Least share of all places that lie on the ground, in percent.
    fn least_percent(&self) -> u32;

    /// Distance from the plane that counts as on it at first, as a share of the scene's radius.
    fn tolerance(&self) -> f64;

    /// Whether the plane is the ground by what costs more to know, if there is anything.
    fn accepts(&self, _: &[SurfaceSample], _: GroundPlane, _: f64) -> bool {
        true
    }
}

/// How good a plane is, with its up side.
#[derive(Clone, Copy, Debug)]
struct Scored {
    /// The largest one is the ground.
    score: f64,
    /// The places that count as its own, of which there are at least [`Rule::least_percent`].
    counted: f64,
    plane: GroundPlane,
}

/// The ground, and the share of the places that it was found by.
#[derive(Clone, Copy, Debug)]
struct FoundGround {
    share: f64,
    plane: GroundPlane,
}

/// The ground of a scene of which nothing but, perhaps, the direction of up is known.
struct SceneRule {
    up: Option<DVec3>,
    /// Whether only a part of the scene is searched, in which a roof is a plane, too.
    is_core: bool,
}

impl Rule for SceneRule {
    fn score(&self, plane: GroundPlane, beside: &Beside) -> Option<Scored> {
        let Beside { on, above, below, .. } = *beside;
        // Up is the side with more of the scene. Only the smaller side is a penalty: the ground may
        // have all of the scene above it, but not much below. A table top has too few places, and a
        // plane through the middle of a scene has as many below as above.
        let upper = if below > above { plane.turned() } else { plane };
        let score = on - above.min(below);
        // 0.7 is about cos 45 degrees. An up direction of zero length refuses every plane.
        let is_wanted = self.up.is_none_or(|up| upper.up.dot(up.normalize_or_zero()) > 0.7);
        is_wanted.then_some(Scored { score, counted: score, plane: upper })
    }

    fn least_percent(&self) -> u32 {
        LEAST_PERCENT
    }

    fn tolerance(&self) -> f64 {
        TOLERANCE
    }

    fn accepts(&self, places: &[SurfaceSample], plane: GroundPlane, tolerance: f64) -> bool {
        !self.is_core || surrounds(places, plane, tolerance)
    }
}

/// The ground below cameras.
struct CameraRule<'a> {
    cameras: &'a CaptureCameras,
    up: DVec3,
}

impl Rule for CameraRule<'_> {
    fn score(&self, plane: GroundPlane, beside: &Beside) -> Option<Scored> {
        let Beside { near, above, below, .. } = *beside;
        let is_turned = plane.up.dot(self.up) < 0.0;
        let (upper, hanging) = if is_turned { (plane.turned(), above) } else { (plane, below) };
        let most = if self.cameras.have_level_rows() { MOST_SLOPE } else { MOST_TILT };
        // Of planes with as much on them, the one that is most level is the ground.
        let level = 1.0 - (upper.up.angle_between(self.up).to_degrees() / most).powi(2);
        let is_ground = level > 0.0 && self.cameras.are_above(&upper);
        let score = level * near - hanging;
        is_ground.then_some(Scored { score, counted: near, plane: upper })
    }

    fn least_percent(&self) -> u32 {
        LEAST_PERCENT_BELOW
    }

    fn tolerance(&self) -> f64 {
        TOLERANCE_BELOW
    }
}

/// The ground of some Gaussians.
fn ground_in(
    gaussians: &Gaussians,
    core: &[usize],
    search: &GroundSearch,
    rule: &dyn Rule,
) -> Result<FoundGround, GroundError> {
    let radius = extent(gaussians, core).radius;
    let places = places(gaussians, core, radius / CUBES);
    if places.len() < LEAST_PLACES || radius <= 0.0 {
        return Err(GroundError::TooFew { count: places.len(), least: LEAST_PLACES });
    }
    let tolerance = rule.tolerance() * radius;
    // Every `stride`-th place, so that at most COMPARED of them are judged: 3,000 planes times
    // 12,000 places are 36 million products.
    let stride = places.len().div_ceil(COMPARED);
    let compared: Vec<SurfaceSample> = places.iter().copied().step_by(stride).collect();
    let mut random = Random::new(search.seed, "ground", 0);
    let least = f64::from(rule.least_percent()) / 100.0 * compared.len() as f64;
    let mut best: Option<Scored> = None;
    for at in 0..search.hypotheses {
        let Some(plane) = hypothesis(&compared, at, &mut random) else { continue };
        let beside = Beside::new(&compared, &plane, tolerance);
        // A plane with too little on it must not hide the ground, which may have much below it.
        let scored = rule.score(plane, &beside).filter(|scored| scored.counted >= least);
        let Some(scored) = scored else { continue };
        // Strictly greater: of equal planes the first one stays, so that the result is
        // deterministic.
        let is_better = best.is_none_or(|best| scored.score > best.score);
        if is_better && rule.accepts(&compared, scored.plane, tolerance) {
            best = Some(scored);
        }
    }
    let best = best.ok_or(GroundError::NoPlane { least_percent: rule.least_percent() })?;
    let share = best.counted / compared.len() as f64;
    Ok(FoundGround { share, plane: refine(&places, best.plane, tolerance) })
}

/// The Gaussians within a distance of a middle, in the same order.
struct Core {
    gaussians: Vec<usize>,
    reach: f64,
}

impl Core {
    fn within(gaussians: &Gaussians, all: &[usize], middle: DVec3, reach: f64) -> Self {
        let near = all.iter().copied().filter(|&i| distance(gaussians, i, middle) < reach);
        Self { gaussians: near.collect(), reach }
    }
}

fn distance(gaussians: &Gaussians, i: usize, from: DVec3) -> f64 {
    DVec3::from_array(gaussians.means_m[i]).distance(from)
}

/// The middle of the smaller half of some Gaussians, of which there is at least one: what cameras
/// were near is made of small ones, on whatever side of the scene it stands.
fn middle_of_small(gaussians: &Gaussians, some: &[usize]) -> DVec3 {
    let size = |i: usize| gaussians.ln_scales[i].iter().map(|&ln| f64::from(ln)).sum::<f64>();
    let usual = median(some.iter().map(|&i| size(i)).collect());
    let small: Vec<usize> = some.iter().copied().filter(|&i| size(i) <= usual).collect();
    extent(gaussians, &small).middle
}

/// Whether the plane surrounds what stands on it, as the ground does. The roof of a car is a plane
/// too: most of the car is within its edges, or reaches as far as the core does if that cuts it.
fn surrounds(places: &[SurfaceSample], plane: GroundPlane, tolerance: f64) -> bool {
    let foot = |place: &SurfaceSample| place.at - plane.up * plane.up.dot(place.at - plane.point);
    let height = |place: &&SurfaceSample| plane.up.dot(place.at - plane.point);
    let above = places.iter().filter(|place| height(place) > 3.0 * tolerance);
    let feet: Vec<DVec3> = above.map(foot).collect();
    if feet.is_empty() {
        return true;
    }
    let middle = feet.iter().sum::<DVec3>() / feet.len() as f64;
    let away = |place: &SurfaceSample| foot(place).distance(middle);
    let mut reaches: Vec<f64> = feet.iter().map(|foot| foot.distance(middle)).collect();
    let edge = (OBJECT_SHARE * (reaches.len() - 1) as f64) as usize;
    let object = *reaches.select_nth_unstable_by(edge, f64::total_cmp).1;
    let farthest = places.iter().map(away).fold(0.0, f64::max);
    let on = places.iter().filter(|place| height(place).abs() <= tolerance);
    let on: Vec<f64> = on.map(away).collect();
    let beside = on.iter().filter(|&&away| away > object).count();
    object <= MOST_OBJECT * farthest && beside as f64 >= BESIDE_SHARE * on.len() as f64
}

fn extent(gaussians: &Gaussians, opaque: &[usize]) -> SceneExtent {
    if opaque.is_empty() {
        return SceneExtent { middle: DVec3::ZERO, radius: 0.0 };
    }
    // A median for each axis: a sky dome and floaters far away do not move it.
    let axis = |axis: usize| median(opaque.iter().map(|&i| gaussians.means_m[i][axis]).collect());
    let middle = DVec3::new(axis(0), axis(1), axis(2));
    let distance = |&i: &usize| DVec3::from_array(gaussians.means_m[i]).distance(middle);
    SceneExtent { middle, radius: median(opaque.iter().map(distance).collect()) }
}

/// The first Gaussian of each occupied cube, in the order of the Gaussians.
fn places(gaussians: &Gaussians, opaque: &[usize], cube: f64) -> Vec<SurfaceSample> {
    let mut taken = HashSet::new();
    let mut places = Vec::new();
    for &i in opaque {
        let at = DVec3::from_array(gaussians.means_m[i]);
        let key = (at / cube.max(f64::MIN_POSITIVE)).floor().as_i64vec3();
        if taken.insert(key) {
            places.push(SurfaceSample { at, normal: normal(gaussians, i) });
        }
    }
    places
}

/// The thinnest axis of a flat Gaussian.
fn normal(gaussians: &Gaussians, i: usize) -> Option<DVec3> {
    // A difference of logarithms is the logarithm of the ratio: thinnest against middle axis. A
    // needle has two thin axes and is not flat.
    let scales = gaussians.ln_scales[i];
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| scales[a].total_cmp(&scales[b]));
    let is_flat = scales[order[0]] - scales[order[1]] <= FLAT_LN;
    let [w, x, y, z] = gaussians.quats_wxyz[i].map(f64::from);
    let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
    is_flat.then(|| rotation * DVec3::AXES[order[0]])
}

/// A plane through three random places, or through one along its Gaussian.
fn hypothesis(places: &[SurfaceSample], at: usize, random: &mut Random) -> Option<GroundPlane> {
    let mut pick = || places[random.below(places.len())];
    let a = pick();
    let b = pick();
    let c = pick();
    // Half of the hypotheses use one normal, which is right with one lucky draw and not three; the
    // other half also serve scenes of round Gaussians.
    if at.is_multiple_of(2) {
        return a.normal.map(|up| GroundPlane { point: a.at, up });
    }
    let up = (b.at - a.at).cross(c.at - a.at).try_normalize()?;
    Some(GroundPlane { point: a.at, up })
}

/// The places on a plane, and on each of its sides.
#[derive(Clone, Copy, Debug, Default)]
struct Beside {
    /// Places on it, of which those with another normal do not count, and round ones by half.
    on: f64,
    /// Places on it, whatever their normals.
    near: f64,
    above: f64,
    below: f64,
}

impl Beside {
    fn new(places: &[SurfaceSample], plane: &GroundPlane, tolerance: f64) -> Self {
        let mut beside = Self::default();
        for place in places {
            let height = plane.up.dot(place.at - plane.point);
            if height.abs() <= tolerance {
                beside.near += 1.0;
                beside.on += match place.normal {
                    Some(normal) if normal.dot(plane.up).abs() >= LEAST_COSINE => 1.0,
                    Some(_) => 0.0,
                    // A round Gaussian has no information about the direction of its surface.
                    None => 0.5,
                };
            } else if height > 3.0 * tolerance {
                // Between one and three tolerances a place counts neither as on the plane nor
                // beside it: kerbs and the ground's own roughness.
                beside.above += 1.0;
            } else if height < -3.0 * tolerance {
                beside.below += 1.0;
            }
        }
        beside
    }
}

/// Fits the plane with a falling tolerance. Each round first moves the plane to the height that has
/// most of the places near it, because a road is not the mean of itself and the pavements and lawns
/// next to it.
fn refine(places: &[SurfaceSample], mut plane: GroundPlane, tolerance: f64) -> GroundPlane {
    // The largest number of places so far: a round that keeps less than a fifth of them has a
    // tolerance below the roughness of the ground.
    let mut first = 0;
    for round in 0..=REFINEMENTS {
        let tolerance = tolerance * 0.5_f64.powi(round);
        let near = |plane: &GroundPlane, reach: f64| -> Vec<DVec3> {
            let is_near = |place: &&SurfaceSample| {
                let is_level = place.normal.is_none_or(|n| n.dot(plane.up).abs() >= LEAST_COSINE);
                is_level && plane.up.dot(place.at - plane.point).abs() <= reach
            };
            places.iter().filter(is_near).map(|place| place.at).collect()
        };
        let heights: Vec<f64> = near(&plane, 2.0 * tolerance)
            .iter()
            .map(|at| plane.up.dot(*at - plane.point))
            .collect();
        let mut moved = plane;
        if let Some(height) = densest(heights, 0.5 * tolerance) {
            moved.point += height * plane.up;
        }
        let on = near(&moved, tolerance);
        first = first.max(on.len());
        let is_rough = (on.len() as f64) < LEAST_SHARE * first as f64;
        if is_rough {
            break;
        }
        plane = fit(&on).map_or(moved, |fitted| {
            let up = if fitted.up.dot(plane.up) < 0.0 { -fitted.up } else { fitted.up };
            GroundPlane { up, ..fitted }
        });
    }
    plane
}

/// Middle of the window of this width with the most values.
fn densest(mut heights: Vec<f64>, width: f64) -> Option<f64> {
    heights.sort_by(f64::total_cmp);
    // Two ends of a window move through the sorted heights, each only forwards: O(n) after the
    // sort. `best` is a half-open range of indices.
    let mut best = (0, 0);
    let mut from = 0;
    for to in 0..heights.len() {
        while heights[to] - heights[from] > width {
            from += 1;
        }
        if to + 1 - from > best.1 - best.0 {
            best = (from, to + 1);
        }
    }
    let window = &heights[best.0..best.1];
    (!window.is_empty()).then(|| window[window.len() / 2])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tilted floor with a wall behind it, and round noise above.
    fn room(count: usize) -> (Gaussians, GroundPlane) {
        let rotation = DQuat::from_xyzw(0.4, -0.2, 0.6, 0.5).normalize();
        let mut random = Random::new(7, "room", 0);
        let mut gaussians = Gaussians::with_capacity(0, count);
        for i in 0..count {
            let x = random.range(-5.0, 5.0);
            let y = random.range(-5.0, 5.0);
            // Six tenths floor (rough by 1 cm), two tenths wall, two tenths round noise above the
            // floor.
            let (at, turn) = match i % 10 {
                0..=5 => (DVec3::new(x, y, random.range(-0.01, 0.01)), DQuat::IDENTITY),
                6..=7 => (DVec3::new(5.0, y, 0.3 * (x + 5.0)), DQuat::from_rotation_y(1.57)),
                _ => (DVec3::new(x, y, random.range(0.0, 3.0)), DQuat::IDENTITY),
            };
            let thin = if i % 10 < 8 { -6.0 } else { -3.0 };
            let q = rotation * turn;
            gaussians.means_m.push((rotation * at + DVec3::new(20.0, 3.0, -7.0)).to_array());
            gaussians.quats_wxyz.push([q.w, q.x, q.y, q.z].map(|q| q as f32));
            gaussians.ln_scales.push([-3.0, -3.0, thin]);
            gaussians.logit_opacities.push(3.0);
            gaussians.sh.extend([0.0; 3]);
        }
        (gaussians, GroundPlane { point: DVec3::new(20.0, 3.0, -7.0), up: rotation * DVec3::Z })
    }

    #[test]
    fn a_tilted_floor_is_found_and_always_the_same() {
        let (gaussians, wanted) = room(20_000);
        let found = find_ground(&gaussians, &GroundSearch::default()).unwrap();
        assert!(found.up.angle_between(wanted.up).to_degrees() < 0.1, "{found:?}");
        // The floor is rough by 1 cm.
        assert!(found.up.dot(wanted.point - found.point).abs() < 0.01, "{found:?}");
        assert_eq!(find_ground(&gaussians, &GroundSearch::default()).unwrap(), found);
    }

    #[test]
    fn a_known_up_keeps_the_wall_from_being_the_ground() {
        let (gaussians, floor) = room(20_000);
        let across = floor.up.any_orthonormal_vector();
        let found =
            find_ground(&gaussians, &GroundSearch { up: Some(across), ..GroundSearch::default() });
        assert!(found.is_err() || found.unwrap().up.dot(across) > 0.7);
    }

    #[test]
    fn an_empty_scene_and_a_ball_have_no_ground() {
        let none = find_ground(&Gaussians::default(), &GroundSearch::default());
        assert!(matches!(none, Err(GroundError::TooFew { count: 0, .. })), "{none:?}");
        let (mut ball, _) = room(5_000);
        let mut random = Random::new(3, "ball", 0);
        for (mean, quat) in ball.means_m.iter_mut().zip(&mut ball.quats_wxyz) {
            let mut next = || random.range(-1.0, 1.0);
            *mean = (DVec3::new(next(), next(), next()).normalize() * 4.0).to_array();
            *quat = [next(), next(), next(), next()].map(|q| q as f32);
        }
        let found = find_ground(&ball, &GroundSearch::default());
        assert!(matches!(found, Err(GroundError::NoPlane { .. })), "{found:?}");
    }
}
