//! Dynamic objects: moving objects of a scene other than the ego.
//!
//! A request for an image names an object only by its track's id, with poses of the middle of its
//! box. So the id describes the object, as the id of a scene describes the scene, and the server
//! keeps no table:
//!
//! | id | what is drawn |
//! |---|---|
//! | `NAME@ASSET` | an asset of the store, by its hash or its name |
//! | `NAME@LxWxH`, `NAME@LxWxH#RRGGBB` | a box of this length, width and height in metres, grey or in this colour |
//! | `NAME` | a grey box of the size of a car |
//!
//! `wildcity alpasim export --tracks` writes such ids; AlpaSim's runtime repeats those that a
//! scene's file has.

use std::str::FromStr;

use glam::DVec3;

use wildcity_scene::actor::{ActorAsset, AssetDescription, AssetError};
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::rig::is_name;
use wildcity_scene::{ActorBox, ActorClass, Gaussians, sh};

use crate::limits;

/// The box of an unknown object.
const CAR: ActorBox = ActorBox { length_m: 4.6, width_m: 1.9, height_m: 1.6 };

/// Red, green and blue of a box without a colour.
const GREY: [u8; 3] = [128, 128, 128];

/// Edge of a box's cells, in metres, and the most cells along an edge: a box has at most 1,280.
const CELL_M: f64 = 0.1;
const MOST_CELLS: f64 = 16.0;

/// Standard deviation of a cell's Gaussian, as a fraction of the cell's edge, and across the face,
/// in metres.
const OVERLAP: f64 = 0.66;
const THICKNESS_M: f64 = 0.004;

/// Characters of a long id that an error names.
const NAMED: usize = 64;

/// The logit of an opacity of 0.99.
const LOGIT_OPACITY: f32 = 4.595;

/// Factor of the colour of a face, so that the edges of a box are visible: front and rear, left and
/// right, top.
const SHADES: [f64; 3] = [0.7, 0.85, 1.0];

/// The shape of an object.
#[derive(Clone, Debug, PartialEq)]
pub enum ObjectShape {
    /// An asset, by its hash or its name.
    Asset(String),
    Box {
        size: ActorBox,
        /// Its red, green and blue.
        rgb8: [u8; 3],
    },
    /// Unknown: a grey box of the size of a car.
    Unknown,
}

/// Why a track id is invalid.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "dynamic_objects: track_id {id:?}: {reason}; expected NAME@ASSET, NAME@LxWxH or NAME@LxWxH#RRGGBB with metres, \
     or a NAME without @"
)]
pub struct ObjectError {
    /// The refused id, or the first characters of an id that is too long.
    pub id: String,
    pub reason: String,
}

impl ObjectShape {
    /// The object of a track's id.
    ///
    /// # Errors
    /// It is longer than [`limits::TRACK_ID_BYTES`], or the text after its `@` is neither a name
    /// nor a size that an actor may have.
    pub fn from_track(id: &str) -> Result<Self, ObjectError> {
        let most = limits::TRACK_ID_BYTES;
        if id.len() > most {
            let reason = format!(
                "these are the first {NAMED} characters of {} bytes; at most {most} are accepted",
                id.len()
            );
            return Err(ObjectError { id: id.chars().take(NAMED).collect(), reason });
        }
        // The last `@`: the name of a track may have one, and a shape has none.
        let Some((_, shape)) = id.rsplit_once('@') else { return Ok(Self::Unknown) };
        shape.parse().map_err(|reason| ObjectError { id: id.to_owned(), reason })
    }

    /// Key of the shape, which is equal for equal boxes, however they were written. The key of a
    /// box has a `#`, which names and hashes cannot have.
    pub fn key(&self) -> String {
        let (size, [red, green, blue]) = match self {
            Self::Asset(name) => return name.clone(),
            Self::Box { size, rgb8 } => (size, *rgb8),
            Self::Unknown => (&CAR, GREY),
        };
        let ActorBox { length_m, width_m, height_m } = size;
        // f64 prints the shortest text of a number, so that 4, 4.0 and 04 have one key.
        format!("{length_m}x{width_m}x{height_m}#{red:02x}{green:02x}{blue:02x}")
    }

    /// The box, unless it is that of an asset.
    pub fn size(&self) -> Option<ActorBox> {
        match self {
            Self::Asset(_) => None,
            Self::Box { size, .. } => Some(*size),
            Self::Unknown => Some(CAR),
        }
    }

    /// The asset of a box; `None` for an asset of the store.
    ///
    /// # Errors
    /// It has too many Gaussians, which never happens for a checked box.
    pub fn box_asset(&self) -> Result<Option<ActorAsset>, AssetError> {
        let (size, rgb8) = match self {
            Self::Asset(_) => return Ok(None),
            Self::Box { size, rgb8 } => (*size, *rgb8),
            Self::Unknown => (CAR, GREY),
        };
        let description = AssetDescription {
            name: "box".to_owned(),
            class: ActorClass::Object,
            box_: size,
            provenance: Provenance::new("box".to_owned()),
        };
        ActorAsset::new(&gaussians(size, rgb8), description).map(Some)
    }
}

/// Parses the text after the `@` of an id.
impl FromStr for ObjectShape {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (size, colour) = match text.split_once('#') {
            Some((size, colour)) => (size, Some(colour)),
            None => (text, None),
        };
        // `map_while` stops at the first part that is no number, so that the count of parts is
        // compared below.
        let extents: Vec<f64> = size.split('x').map_while(|part| part.parse().ok()).collect();
        let [length_m, width_m, height_m] = match extents[..] {
            [length_m, width_m, height_m] if size.split('x').count() == 3 => {
                [length_m, width_m, height_m]
            }
            _ if colour.is_none() && is_name(text) => return Ok(Self::Asset(text.to_owned())),
            _ => return Err(format!("{text:?} is no asset and no size")),
        };
        // Rust reads 1e1 and +2 as numbers, too.
        if !size.bytes().all(|byte| byte.is_ascii_digit() || b".x".contains(&byte)) {
            return Err(format!("{size:?} is no size: metres have digits and one point"));
        }
        let size = ActorBox { length_m, width_m, height_m };
        size.check().map_err(|error| error.to_string())?;
        let rgb8 = match colour {
            None => GREY,
            Some(hex) => {
                rgb8(hex).ok_or_else(|| format!("{hex:?} is no colour of 6 hex digits"))?
            }
        };
        Ok(Self::Box { size, rgb8 })
    }
}

/// The id of a track that is drawn as an asset.
pub fn id_of_asset(name: &str, hash: &str) -> String {
    format!("{name}@{hash}")
}

/// The id of a track that is drawn as a box.
pub fn id_of_box(name: &str, size: &ActorBox) -> String {
    format!("{name}@{}x{}x{}", size.length_m, size.width_m, size.height_m)
}

/// The pose of an actor, whose origin is on the ground, from that of the middle of its box.
pub fn actor_of_centre(centre: &Pose, size: &ActorBox) -> Pose {
    raised(centre, -0.5 * size.height_m)
}

/// The pose of the middle of an actor's box.
pub fn centre_of_actor(actor: &Pose, size: &ActorBox) -> Pose {
    raised(actor, 0.5 * size.height_m)
}

/// A pose moved along its own z axis.
pub(crate) fn raised(pose: &Pose, by_m: f64) -> Pose {
    Pose { position_m: pose.position_m + pose.rotation * DVec3::new(0.0, 0.0, by_m), ..*pose }
}

fn rgb8(hex: &str) -> Option<[u8; 3]> {
    let is_hex = hex.len() == 6 && hex.bytes().all(|byte| byte.is_ascii_hexdigit());
    let number = is_hex.then(|| u32::from_str_radix(hex, 16).ok())??;
    // Six digits are below 2^24, so the first byte is 0.
    let [_, red, green, blue] = number.to_be_bytes();
    Some([red, green, blue])
}

/// The five faces of a box that are not on the ground, as flat Gaussians.
fn gaussians(size: ActorBox, rgb8: [u8; 3]) -> Gaussians {
    let extents_m = DVec3::new(size.length_m, size.width_m, size.height_m);
    // 1 to 16 cells along each edge: at most 5 faces of 16 x 16, which are 1,280. The cells of a
    // large box are larger.
    let cells = (extents_m / CELL_M).ceil().min(DVec3::splat(MOST_CELLS)).max(DVec3::ONE);
    let cell_m = extents_m / cells;
    let mut gaussians = Gaussians::default();
    // The lower face is never seen: it is on the ground.
    let faces = [(0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0), (2, 1.0)];
    for (axis, side) in faces {
        // A Gaussian at each cell's middle with 0.66 of the cell as its standard deviation leaves
        // no gap between two cells.
        let mut sigmas_m = OVERLAP * cell_m;
        sigmas_m[axis] = THICKNESS_M;
        let rgb = rgb8.map(|value| SHADES[axis] * f64::from(value) / 255.0);
        // The inverse of colour = 0.5 + C0 dc.
        let dc = rgb.map(|value| ((value - 0.5) / sh::C0) as f32);
        // The two axes within the face.
        let u = (axis + 1) % 3;
        let v = (axis + 2) % 3;
        for i in 0..cells[u] as usize {
            for j in 0..cells[v] as usize {
                // From the middle of the box.
                let mut at_m = DVec3::ZERO;
                at_m[axis] = 0.5 * side * extents_m[axis];
                at_m[u] = (i as f64 + 0.5) * cell_m[u] - 0.5 * extents_m[u];
                at_m[v] = (j as f64 + 0.5) * cell_m[v] - 0.5 * extents_m[v];
                // An actor's origin is on the ground.
                at_m.z += 0.5 * extents_m.z;
                gaussians.means_m.push(at_m.to_array());
                gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
                gaussians.ln_scales.push(sigmas_m.to_array().map(|sigma_m| sigma_m.ln() as f32));
                gaussians.logit_opacities.push(LOGIT_OPACITY);
                gaussians.sh.extend(dc);
            }
        }
    }
    gaussians
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_says_what_is_drawn() {
        let size = ActorBox { length_m: 4.5, width_m: 1.8, height_m: 1.5 };
        let red = [0xc0, 0x10, 0x20];
        let shape = |id: &str| ObjectShape::from_track(id).unwrap();
        assert_eq!(shape("7@sedan"), ObjectShape::Asset("sedan".to_owned()));
        assert_eq!(shape("7@4.5x1.8x1.5"), ObjectShape::Box { size, rgb8: GREY });
        assert_eq!(shape("a@b@4.5x1.8x1.5#C01020"), ObjectShape::Box { size, rgb8: red });
        assert_eq!(shape("17"), ObjectShape::Unknown);
        // Two extents are no size, but may be a name.
        assert_eq!(shape("7@4.5x1.8"), ObjectShape::Asset("4.5x1.8".to_owned()));
        assert_eq!(shape(&id_of_box("7", &size)).size(), Some(size));
        assert_eq!(shape(&id_of_asset("7", "ab12")), ObjectShape::Asset("ab12".to_owned()));
        for (id, reason) in [
            ("7@", "no asset and no size"),
            ("7@Sedan", "no asset and no size"),
            ("7@4.5x1.8x0", "height_m is 0.0"),
            ("7@4.5xnanx1.5", "digits and one point"),
            ("7@1e1x2x1", "digits and one point"),
            ("7@4x+2x1", "digits and one point"),
            ("7@4x-2x1", "digits and one point"),
            ("7@4.5x1.8x1.5#12345", "6 hex digits"),
            ("7@sedan#123456", "no asset and no size"),
        ] {
            let text = ObjectShape::from_track(id).unwrap_err().to_string();
            assert!(text.contains(reason) && text.contains(id), "{text}");
        }
    }

    #[test]
    fn a_long_id_is_refused_by_its_first_characters() {
        // Two bytes each, so that exactly as many bytes as are accepted.
        let long = "é".repeat(limits::TRACK_ID_BYTES / 2);
        assert_eq!(ObjectShape::from_track(&long), Ok(ObjectShape::Unknown));
        let text = ObjectShape::from_track(&format!("{long}a")).unwrap_err().to_string();
        assert!(text.contains("257 bytes; at most 256 are accepted"), "{text}");
        assert_eq!(text.matches('é').count(), 64, "{text}");
    }

    #[test]
    fn equal_boxes_have_one_key() {
        let key = |id: &str| ObjectShape::from_track(id).unwrap().key();
        assert_eq!(key("7@4x2x1"), "4x2x1#808080");
        // Other names, spellings of a number, and the default colour written out.
        for same in ["8@4.0x2x1", "7@4x02.0x1.#808080"] {
            assert_eq!(key(same), "4x2x1#808080", "{same}");
        }
        assert_eq!(key("7@4x2x1#C01020"), key("7@4x2x1#c01020"));
        for other in ["7@4x2x1.5", "7@2x4x1", "7@4x2x1#808081"] {
            assert_ne!(key(other), "4x2x1#808080", "{other}");
        }
        assert_eq!(key("17"), key("18@4.6x1.9x1.6"));
        assert_eq!(key("7@sedan"), "sedan");
    }

    #[test]
    fn a_box_has_its_size_and_colour() {
        let size = ActorBox { length_m: 4.5, width_m: 1.8, height_m: 1.5 };
        let asset = ObjectShape::Box { size, rgb8: [255, 0, 51] }.box_asset().unwrap().unwrap();
        let all = gaussians(size, [255, 0, 51]);
        assert_eq!(asset.levels[0].chunk.len(), all.len());
        let bounds = ActorAsset::bounds(&all);
        // Every face but the lower one has Gaussians, on the face.
        assert!((bounds.min_m - DVec3::new(-2.25, -0.9, 0.05)).length() < 1e-9, "{bounds:?}");
        assert!((bounds.max_m - DVec3::new(2.25, 0.9, 1.5)).length() < 1e-9, "{bounds:?}");
        // The top has the shade 1, so that its colour is the given one: 51 of 255 is 0.2.
        let top = (0..all.len()).find(|&index| all.means_m[index][2] == 1.5).unwrap();
        let rgb = all.sh_at(top).iter().map(|&dc| 0.5 + sh::C0 * f64::from(dc));
        for (value, wanted) in rgb.zip([1.0, 0.0, 0.2]) {
            assert!((value - wanted).abs() < 1e-6, "{value} {wanted}");
        }
        // The largest box that may be is no more than five faces of the most cells.
        let large = ActorBox { length_m: 100.0, width_m: 100.0, height_m: 100.0 };
        assert_eq!(gaussians(large, GREY).len(), 5 * 16 * 16);
        assert!(gaussians(ActorBox { height_m: 0.01, ..large }, GREY).len() <= 16 * 16 + 4 * 16);
        assert!(ObjectShape::Unknown.box_asset().unwrap().is_some());
        assert!(ObjectShape::Asset("sedan".to_owned()).box_asset().unwrap().is_none());
    }

    #[test]
    fn the_middle_of_a_box_is_half_its_height_above_the_ground() {
        let size = ActorBox { length_m: 4.5, width_m: 1.8, height_m: 1.5 };
        let rotation = glam::DQuat::from_rotation_x(0.1);
        let centre = Pose { position_m: DVec3::new(1.0, 2.0, 3.0), rotation };
        let actor = actor_of_centre(&centre, &size);
        assert!(((actor.position_m - centre.position_m).length() - 0.75).abs() < 1e-12);
        assert!(actor.position_m.z < 2.26);
        let again = centre_of_actor(&actor, &size);
        assert!((again.position_m - centre.position_m).length() < 1e-12);
    }
}
