//! References in a view, against scenes whose images are known in closed form.

use std::sync::Arc;

use glam::{DQuat, DVec2, DVec3};
use wildcity_repair::Image;
use wildcity_repair::reference::{
    Projection, Rays, Reference, ReferenceCache, WarpTarget, Warped, opaque_depth, overlaps, warp,
};
use wildcity_scene::geometry::camera::{Fisheye, Lens, OpenCv, Pinhole, ShutterDirection};
use wildcity_scene::geometry::{Camera, Pose};

/// A wall 10 m ahead, and perhaps a board in front of it, 5 m ahead and 2 m wide.
#[derive(Clone, Copy)]
struct Walls {
    has_board: bool,
}

const WALL_M: f64 = 10.0;
const BOARD_M: f64 = 5.0;

impl Walls {
    /// Where a ray (any length) ends; `None` if it never does.
    fn hit(self, from_m: DVec3, ray: DVec3) -> Option<DVec3> {
        let at = |z_m: f64| from_m + ray * ((z_m - from_m.z) / ray.z);
        if ray.z <= 1e-3 {
            return None;
        }
        let board = at(BOARD_M);
        if self.has_board && board.x.abs() <= 1.0 {
            return Some(board);
        }
        Some(at(WALL_M))
    }

    /// Linear on the wall, so that interpolation between pixels is exact up to rounding; the board
    /// is blue.
    fn colour(point_m: DVec3) -> [u8; 3] {
        if point_m.z < WALL_M - 1.0 {
            return [0, 0, 250];
        }
        let level = |value: f64| (128.0 + value).round().clamp(0.0, 255.0) as u8;
        [level(6.0 * point_m.x), level(9.0 * point_m.y), 30]
    }

    fn depth(self, camera: &Camera, pose_at: &dyn Fn(DVec2) -> Pose) -> (Image, Vec<f32>) {
        let width = camera.width_px as usize;
        let height = camera.height_px as usize;
        let mut rgb8 = Vec::new();
        let mut depth_m = Vec::new();
        for at in 0..width * height {
            let at_px = pixel(at, width);
            let pose = pose_at(at_px);
            let ray = camera.unproject(at_px).map(|ray| pose.rotation * ray);
            match ray.and_then(|ray| self.hit(pose.position_m, ray)) {
                None => {
                    rgb8.extend([255, 0, 255]);
                    depth_m.push(0.0);
                }
                Some(point_m) => {
                    rgb8.extend(Self::colour(point_m));
                    let point = pose.inverse().transform_point(point_m);
                    depth_m.push(camera.depth_m(point) as f32);
                }
            }
        }
        (Image { width, height, rgb8 }, depth_m)
    }

    fn reference(self, camera: &Camera, pose: Pose) -> Arc<Reference> {
        let (image, depth_m) = self.depth(camera, &|_| pose);
        let projection = Arc::new(Projection::from_camera(camera));
        Arc::new(Reference { image, depth_m, projection, world_from_camera: pose })
    }

    fn warped(self, camera: &Camera, pose: Pose, references: &[Arc<Reference>]) -> Warped {
        let (_, depth_m) = self.depth(camera, &|_| pose);
        warp(
            &WarpTarget {
                camera,
                rays: &Rays::from_camera(camera),
                world_from_camera: pose,
                shutter: None,
                depth_m: &depth_m,
            },
            references,
        )
    }
}

fn pixel(at: usize, width: usize) -> DVec2 {
    DVec2::new((at % width) as f64 + 0.5, (at / width) as f64 + 0.5)
}

fn pinhole() -> Camera {
    Camera::from_pinhole(203, 121, Pinhole { fx: 150.0, fy: 155.0, cx: 100.0, cy: 62.0 })
}

fn at(x: f64, y: f64, z: f64) -> Pose {
    // Turned by some degrees, so that rows and columns of a rotation cannot be exchanged unnoticed.
    let rotation = DQuat::from_euler(glam::EulerRot::XYZ, 0.02, 0.05 * x, -0.03);
    Pose { position_m: DVec3::new(x, y, z), rotation }
}

/// What the point of a pixel looks like, and where it is on the image of a reference. `None` where
/// the view sees nothing.
fn truth(
    walls: Walls,
    camera: &Camera,
    pose: &Pose,
    at_px: DVec2,
    reference: (&Camera, &Pose),
) -> Option<([u8; 3], Option<DVec2>, bool)> {
    let ray = pose.rotation * camera.unproject(at_px)?;
    let point_m = walls.hit(pose.position_m, ray)?;
    let (other, other_pose) = reference;
    let there = other.project(other_pose.inverse().transform_point(point_m));
    let hit_m = walls.hit(other_pose.position_m, point_m - other_pose.position_m);
    let is_seen = hit_m.is_some_and(|hit_m| hit_m.distance(point_m) < 0.01);
    Some((Walls::colour(point_m), there, is_seen))
}

/// Compares a warp of one reference with the truth, but for a margin of pixels at the borders of
/// the reference's image. Returns how many pixels were compared as valid and as not valid.
fn compare(walls: Walls, camera: &Camera, target: Pose, other: &Camera, from: Pose) -> [usize; 2] {
    let warped = walls.warped(camera, target, &[walls.reference(other, from)]);
    let width = camera.width_px as usize;
    let mut compared = [0, 0];
    let margin_px = 2.0;
    for (index, valid) in warped.valid.iter().enumerate() {
        let at_px = pixel(index, width);
        let rgb = &warped.image.rgb8[3 * index..][..3];
        let Some((colour, there, is_seen)) = truth(walls, camera, &target, at_px, (other, &from))
        else {
            assert_eq!((*valid, rgb), (0.0, &[0, 0, 0][..]), "{at_px}");
            continue;
        };
        let inside = there.map(|there| {
            let to_border = there.min(other.size_px() - there);
            to_border.min_element()
        });
        // Near the edge of the board, a pixel of the reference is half of each.
        let is_edge = walls.has_board
            && [DVec2::X, DVec2::NEG_X].iter().any(|step| {
                let near = truth(walls, camera, &target, at_px + 2.0 * step, (other, &from));
                near.is_none_or(|(near, _, seen)| seen != is_seen || (near[2] != colour[2]))
            });
        if is_edge || inside.is_some_and(|px| px.abs() < margin_px) {
            continue;
        }
        let expected = is_seen && inside.is_some_and(|px| px > 0.0);
        assert_eq!(*valid, f32::from(u8::from(expected)), "{at_px} is at {there:?} there");
        if !expected {
            assert_eq!(rgb, [0, 0, 0], "{at_px}");
            compared[1] += 1;
            continue;
        }
        for channel in 0..3 {
            let difference = rgb[channel].abs_diff(colour[channel]);
            assert!(difference <= 1, "{at_px}: {rgb:?}, not {colour:?}");
        }
        compared[0] += 1;
    }
    compared
}

#[test]
fn a_wall_is_seen_again_from_beside_and_behind() {
    let walls = Walls { has_board: false };
    let camera = pinhole();
    for from in [at(1.0, 0.0, 0.0), at(-2.0, 0.3, -4.0), at(0.5, -0.5, 2.0)] {
        let [valid, outside] = compare(walls, &camera, at(0.0, 0.0, 0.0), &camera, from);
        assert!(valid > 8_000, "{valid} valid pixels, {outside} others from {from:?}");
    }
}

#[test]
fn what_a_board_hides_from_the_reference_is_not_valid() {
    let walls = Walls { has_board: true };
    let camera = pinhole();
    let target = at(0.0, 0.0, 0.0);
    let [valid, hidden] = compare(walls, &camera, target, &camera, at(1.5, 0.0, 0.0));
    assert!(valid > 8_000 && hidden > 2_000, "{valid} valid pixels, {hidden} others");
}

#[test]
fn bent_lenses_are_warped_like_pinholes() {
    let walls = Walls { has_board: false };
    let bent = |lens| Camera { lens, ..pinhole() };
    let fisheye = bent(Lens::Fisheye(Fisheye::new([0.01, -0.004, 0.0, 0.0], Some(1.2))));
    let distortion = [-0.12, 0.02, 0.0, 0.0, 0.0, 0.0];
    let opencv = bent(Lens::opencv(OpenCv::new(distortion, [1e-3, 2e-3], [0.0; 4])));
    let target = at(0.0, 0.0, 0.0);
    let from = at(0.8, 0.2, -2.0);
    for [camera, other] in
        [[fisheye, pinhole()], [pinhole(), fisheye], [fisheye, opencv], [opencv, opencv]]
    {
        let [valid, _] = compare(walls, &camera, target, &other, from);
        assert!(valid > 8_000, "{valid} valid pixels of {camera:?} from {other:?}");
    }
}

#[test]
fn the_smallest_angle_wins_and_the_first_of_equals() {
    let walls = Walls { has_board: false };
    let camera = pinhole();
    let painted = |pose: Pose, colour: [u8; 3]| {
        let reference = walls.reference(&camera, pose);
        let pixels = reference.depth_m.len();
        let image = Image { rgb8: colour.repeat(pixels), ..reference.image.clone() };
        let Reference { depth_m, projection, .. } = &*reference;
        let depth_m = depth_m.clone();
        let projection = projection.clone();
        Arc::new(Reference { image, depth_m, projection, world_from_camera: pose })
    };
    let near = painted(at(0.4, 0.0, -1.0), [200, 0, 0]);
    let far = painted(at(-2.5, 0.0, -1.0), [0, 200, 0]);
    let twin = painted(at(0.4, 0.0, -1.0), [0, 0, 200]);
    let of = |references: &[&Arc<Reference>]| {
        let references: Vec<Arc<Reference>> =
            references.iter().map(|one| Arc::clone(one)).collect();
        let warped = walls.warped(&camera, at(0.0, 0.0, 0.0), &references);
        let middle = 60 * 203 + 100;
        (warped.image.rgb8[3 * middle..][..3].to_vec(), warped.pixels)
    };
    assert_eq!(of(&[&near, &far]).0, [200, 0, 0]);
    assert_eq!(of(&[&far, &near]).0, [200, 0, 0]);
    let (colour, pixels) = of(&[&near, &twin]);
    assert_eq!(colour, [200, 0, 0]);
    assert_eq!(pixels[1], 0, "the second of two equal references gives nothing");
    assert!(pixels[0] > 8_000);
}

#[test]
fn rows_of_a_moving_camera_have_their_own_poses() {
    let walls = Walls { has_board: false };
    let camera = pinhole();
    let first = Pose { position_m: DVec3::new(-0.8, 0.0, -0.5), ..at(0.0, 0.0, 0.0) };
    let last = at(0.0, 0.0, 0.0);
    let rays = Rays::from_camera(&camera);
    let reference = walls.reference(&camera, at(0.3, 0.0, -1.0));
    let directions = [
        ShutterDirection::TopToBottom,
        ShutterDirection::BottomToTop,
        ShutterDirection::LeftToRight,
        ShutterDirection::RightToLeft,
    ];
    for direction in directions {
        let pose_at = |at_px: DVec2| first.interpolate(&last, direction.fraction(at_px, &camera));
        let (image, depth_m) = walls.depth(&camera, &pose_at);
        let target = WarpTarget {
            camera: &camera,
            rays: &rays,
            world_from_camera: last,
            shutter: Some((direction, first)),
            depth_m: &depth_m,
        };
        let warped = warp(&target, std::slice::from_ref(&reference));
        let mut compared = 0;
        for index in (0..depth_m.len()).filter(|index| warped.valid[*index] > 0.0) {
            let pixels = [&warped.image, &image].map(|image| &image.rgb8[3 * index..][..3]);
            // Sixteen columns share a pose: 4 cm, or a level of colour, here.
            let difference = (0..3).map(|c| pixels[0][c].abs_diff(pixels[1][c])).max();
            assert!(difference <= Some(2), "{direction:?} {index}: {pixels:?}");
            compared += 1;
        }
        assert!(compared > 8_000, "{direction:?}: {compared}");
    }
}

#[test]
fn nothing_comes_without_depth_or_from_far_beside() {
    let walls = Walls { has_board: false };
    let camera = pinhole();
    let target = at(0.0, 0.0, 0.0);
    let (_, depth_m) = walls.depth(&camera, &|_| target);
    let opacity: Vec<f32> = (0..depth_m.len()).map(|at| [0.49, 0.5][at % 2]).collect();
    let opaque = opaque_depth(&depth_m, &opacity);
    let rays = Rays::from_camera(&camera);
    let view = WarpTarget {
        camera: &camera,
        rays: &rays,
        world_from_camera: target,
        shutter: None,
        depth_m: &opaque,
    };
    let reference = walls.reference(&camera, at(0.2, 0.0, 0.0));
    let warped = warp(&view, std::slice::from_ref(&reference));
    let valid = |parity: usize| {
        warped.valid.iter().skip(parity).step_by(2).map(|valid| f64::from(*valid)).sum::<f64>()
    };
    assert_eq!(valid(0), 0.0, "pixels of low opacity have no depth");
    assert!(valid(1) > 8_000.0);

    // One pixel of each block is tested, so all have a depth in this test.
    let view = WarpTarget { depth_m: &depth_m, ..view };
    assert!(overlaps(&view, &camera, &reference.world_from_camera));
    let turned = Pose { rotation: DQuat::from_rotation_y(2.0), ..target };
    assert!(!overlaps(&view, &camera, &turned));
    let away = Pose { position_m: DVec3::new(40.0, 0.0, 0.0), ..target };
    assert!(!overlaps(&view, &camera, &away));
    assert!(warp(&view, &[walls.reference(&camera, away)]).valid.iter().all(|valid| *valid == 0.0));
}

#[test]
fn a_depth_that_differs_by_more_than_the_limit_does_not_fit() {
    let walls = Walls { has_board: false };
    let camera = pinhole();
    let target = at(0.0, 0.0, 0.0);
    let fits = |factor: f32| {
        let exact = walls.reference(&camera, at(0.2, 0.0, 0.0));
        let depth_m = exact.depth_m.iter().map(|depth_m| depth_m * factor).collect();
        let Reference { image, projection, world_from_camera, .. } = &*exact;
        let image = image.clone();
        let projection = projection.clone();
        let world_from_camera = *world_from_camera;
        let reference = Arc::new(Reference { image, depth_m, projection, world_from_camera });
        let warped = walls.warped(&camera, target, &[reference]);
        warped.valid[60 * 203 + 100] > 0.0
    };
    // At 10 m the limit is 0.7 m, 7 %.
    assert!(fits(1.0) && fits(1.06) && fits(0.94));
    assert!(!fits(1.08) && !fits(0.92));
}

#[test]
fn the_cache_forgets_what_was_not_used_for_longest() {
    let walls = Walls { has_board: false };
    let reference = walls.reference(&pinhole(), at(0.0, 0.0, 0.0));
    let bytes = reference.bytes();
    assert_eq!(bytes, 203 * 121 * 7);
    let cache = ReferenceCache::new(2 * bytes + 1);
    let key = |number: u8| [number; 32];
    for number in [1, 2] {
        cache.insert(key(number), reference.clone());
    }
    assert!(cache.get(&key(1)).is_some(), "used again");
    cache.insert(key(3), reference.clone());
    assert_eq!(cache.held(), (2, 2 * bytes));
    assert!(cache.get(&key(2)).is_none() && cache.get(&key(1)).is_some());
    // An existing key takes no more memory, and a reference larger than the cache is not kept.
    cache.insert(key(1), reference.clone());
    assert_eq!(cache.held(), (2, 2 * bytes));
    let small = ReferenceCache::new(bytes - 1);
    small.insert(key(1), reference);
    assert_eq!(small.held(), (0, 0));
}
