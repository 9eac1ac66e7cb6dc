//! Assets of actors from files: `wildcity actor import` and pushes of assets make them alike.

use std::sync::Arc;

use glam::DVec3;
use tokio::time::timeout;

use wildcity_scene::actor::{ActorAsset, AssetDescription};
use wildcity_scene::geometry::{Bounds, Pose};
use wildcity_scene::rig::is_name;
use wildcity_scene::{ActorBox, ActorClass, Gaussians, RecordFormat};
use wildcity_twin::ingest::StopFlag;
use wildcity_twin::store::{AddedActor, Catalog, SameName};

use crate::blocking::run_blocking;
use crate::error::PushError;
use crate::limits;
use crate::queue::PushQueue;
use crate::read::{ReadBounds, read};
use crate::request::{RequestedFile, check_files};
use crate::source::{SourceAxes, SourceFile, provenance};
use crate::status::{Push, State};

/// Request for a push of an asset.
#[derive(Clone, Debug)]
pub struct AssetRequest {
    /// The files, which become one scene.
    pub files: Vec<RequestedFile>,
    pub settings: AssetSettings,
}

/// Settings of an asset in addition to its Gaussians.
#[derive(Clone, Debug)]
pub struct AssetSettings {
    pub name: String,
    pub class: ActorClass,
    /// Number of flat Gaussians that cover the triangles of a mesh.
    pub mesh_gaussians: u32,
    /// How its Gaussians are stored.
    pub record: RecordFormat,
}

/// Gaussians in the directions and the unit of the actor's axes, and their sources.
#[derive(Clone, Debug)]
pub struct AssetSource {
    /// The Gaussians. Their origin may be anywhere.
    pub gaussians: Gaussians,
    /// BLAKE3 of each file, in hex.
    pub hashes: Vec<String>,
    /// The axes and scale of each file.
    pub options: Vec<String>,
}

impl AssetRequest {
    /// Checks everything that can be checked without the files.
    ///
    /// # Errors
    /// Names the first field that is outside its limits.
    pub fn check(&self) -> Result<(), PushError> {
        let AssetSettings { name, mesh_gaussians, .. } = &self.settings;
        // The name is a part of a path in the store, so it is checked before anything else.
        if !is_name(name) {
            return Err(PushError::InvalidName { field: "name", name: name.clone() });
        }
        check_files(&self.files)?;
        let range = limits::ACTOR_MESH_GAUSSIANS_RANGE;
        if !range.contains(mesh_gaussians) {
            let (least, most) = range.into_inner();
            let must = format!("{mesh_gaussians}; {least} to {most} are accepted");
            return Err(PushError::OutOfRange { field: "gaussians".to_owned(), must });
        }
        Ok(())
    }

    /// Bytes of memory that making the asset may use, for files of `file_bytes` bytes.
    fn memory_bytes(&self, file_bytes: u64) -> u64 {
        let mesh_gaussians = u64::from(self.settings.mesh_gaussians);
        // A file may be a mesh, so the number of Gaussians that is asked for counts in addition to
        // the bytes. The product of a u32 and 952 does not wrap a u64.
        limits::push_memory_bytes(file_bytes)
            .saturating_add(limits::MEMORY_PER_MESH_GAUSSIAN * mesh_gaussians)
    }
}

/// Makes an asset whose origin is on the ground under the middle of its Gaussians' centres.
///
/// # Errors
/// [`PushError::Content`] if there are no Gaussians, too many, or they do not fit an actor's box.
pub fn make_asset(source: AssetSource, settings: &AssetSettings) -> Result<ActorAsset, PushError> {
    let AssetSource { mut gaussians, hashes, mut options } = source;
    let box_ = center(&mut gaussians)?;
    // The same file with another number of Gaussians is another asset, so the number belongs to the
    // provenance.
    options.push(format!("gaussians={}", settings.mesh_gaussians));
    let description = AssetDescription {
        name: settings.name.clone(),
        class: settings.class,
        box_,
        provenance: provenance(&hashes, options, true),
    };
    ActorAsset::new(&gaussians, description).map_err(|error| refused(error.to_string()))
}

/// Moves Gaussians so that their origin is on the ground under the middle of their box. Returns the
/// box.
fn center(gaussians: &mut Gaussians) -> Result<ActorBox, PushError> {
    // Without Gaussians the bounds would be infinite, and so would the box.
    if gaussians.is_empty() {
        return Err(refused("there are no Gaussians to make an actor of".to_owned()));
    }
    let Bounds { min_m, max_m } = ActorAsset::bounds(gaussians);
    let middle_m = 0.5 * (min_m + max_m);
    // The poses of an actor are on the ground, so z is that of its lowest point, and not of its
    // middle.
    let origin_m = DVec3::new(middle_m.x, middle_m.y, min_m.z);
    // A translation does not change the extent, so the box is computed from the bounds before it.
    gaussians.transform(&Pose { position_m: -origin_m, ..Pose::IDENTITY });
    let DVec3 { x: length_m, y: width_m, z: height_m } = max_m - min_m;
    let box_ = ActorBox { length_m, width_m, height_m };
    box_.check().map_err(|error| refused(format!("{error}: check the axes and the scale")))?;
    Ok(box_)
}

fn refused(reason: String) -> PushError {
    PushError::Content { reason, cells: Vec::new() }
}

/// Waits for the push's permit, makes the asset, and stores it. Dropping the future before the
/// asset is written abandons the push: nothing of it is visible. The caller ends the push with
/// [`Push::close`].
///
/// # Errors
/// The content is refused, an asset with different content has the name, or the server could not do
/// it; see [`PushError::is_refusal`].
pub async fn publish_asset(
    catalog: &Catalog,
    queue: &PushQueue,
    push: &Arc<Push>,
    request: AssetRequest,
    files: Vec<SourceFile>,
) -> Result<AddedActor, PushError> {
    // A name of a twin does not start with a dot. Pushes of assets with one name run one after the
    // other, so that two assets cannot be stored under the same name.
    let name = format!(".actors/{}", request.settings.name);
    // The time of waiting does not count towards the limit below: only reading is limited.
    let file_bytes = files.iter().map(|file| file.bytes).sum();
    let permit = queue.permit_with(&name, request.memory_bytes(file_bytes)).await?;

    push.enter(State::Ingesting)?;
    let record = request.settings.record;
    let bounds = ReadBounds {
        memory_bytes: permit.memory_bytes(),
        mesh_gaussians: request.settings.mesh_gaussians,
        most_gaussians: ActorAsset::MOST_GAUSSIANS as u64,
        too_many_fix: "an actor is one vehicle or person; reduce its Gaussians",
        drop_bad: false,
    };
    // Blocking threads hold a clone of the permit, because they may outlive their push for a
    // moment.
    let stopping = StopWhenDropped(push.stop_flag().clone());
    let made = {
        let permit = permit.clone();
        let push = push.clone();
        run_blocking(move || {
            let _permit = permit;
            let scene = read(&push, &request.files, &files, &SourceAxes::default(), bounds)?;
            let source = AssetSource {
                gaussians: scene.gaussians,
                hashes: scene.hashes,
                options: scene.options,
            };
            make_asset(source, &request.settings)
        })
    };
    // At the limit the thread still runs. The stop flag, which is set as `stopping` is dropped on
    // the way out, ends it soon.
    let limit = queue.check_timeout();
    let made = timeout(limit, made).await.map_err(|_| PushError::TimedOut { limit })?;
    let asset = made.map_err(|error| push.cause(error))?;
    drop(stopping);

    // From here on, the push cannot be cancelled.
    push.enter(State::Committing)?;
    let catalog = catalog.clone();
    run_blocking(move || {
        let _permit = permit;
        Ok(catalog.add_actor(&asset, record, SameName::Refused)?)
    })
    .await
}

/// Stops the threads that read the files of a push that is abandoned.
struct StopWhenDropped(StopFlag);

impl Drop for StopWhenDropped {
    fn drop(&mut self) {
        self.0.stop();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings() -> AssetSettings {
        AssetSettings {
            name: "cone".to_owned(),
            class: ActorClass::Object,
            mesh_gaussians: limits::ACTOR_MESH_GAUSSIANS,
            record: RecordFormat::F32,
        }
    }

    fn source(means_m: &[[f64; 3]]) -> AssetSource {
        let mut gaussians = Gaussians::with_capacity(0, means_m.len());
        for &mean_m in means_m {
            gaussians.means_m.push(mean_m);
            gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            // exp(-4) is 18 mm, and the sigmoid of 3 is 0.95.
            gaussians.ln_scales.push([-4.0; 3]);
            gaussians.logit_opacities.push(3.0);
            gaussians.sh.extend([0.2; 3]);
        }
        let options = vec!["axes=identity".to_owned(), "scale=1".to_owned()];
        AssetSource { gaussians, hashes: vec!["ab".to_owned()], options }
    }

    #[test]
    fn the_origin_is_on_the_ground_under_the_middle() {
        // The middle is (12, 21), and the lowest point is at z = 5: this is where the origin comes
        // to.
        let made = make_asset(source(&[[10.0, 20.0, 5.0], [14.0, 22.0, 6.5]]), &settings());
        let ActorAsset { description, levels } = made.unwrap();
        assert_eq!(description.box_, ActorBox { length_m: 4.0, width_m: 2.0, height_m: 1.5 });
        assert_eq!(description.provenance.source, "blake3:ab");
        assert_eq!(
            description.provenance.options,
            ["axes=identity", "scale=1", "gaussians=200000"]
        );
        let chunk = &levels[0].chunk;
        let mut places: Vec<[f32; 3]> =
            (0..2).map(|i| [0, 1, 2].map(|axis| chunk.value(i, axis))).collect();
        // A level may store its Gaussians in another order than the source.
        places.sort_by(|a, b| a[0].total_cmp(&b[0]));
        assert_eq!(places, [[-2.0, -1.0, 0.0], [2.0, 1.0, 1.5]]);
    }

    #[test]
    fn what_is_no_actor_is_refused_with_its_reason() {
        let refused = |means_m: &[[f64; 3]]| {
            let error = make_asset(source(means_m), &settings()).unwrap_err();
            assert!(error.is_refusal(), "{error}");
            error.to_string()
        };
        assert!(refused(&[]).contains("no Gaussians"));
        let flat = refused(&[[0.0; 3], [1.0, 1.0, 0.0]]);
        assert!(flat.starts_with("height_m is 0.0;") && flat.contains("check the axes"), "{flat}");
        let street = refused(&[[0.0; 3], [300.0, 1.0, 1.0]]);
        assert!(street.starts_with("length_m is 300.0;"), "{street}");
    }

    #[test]
    fn a_field_out_of_range_is_named() {
        let axes = crate::source::SourceAxes::parse("identity", 1.0).unwrap();
        let file = RequestedFile { upload: "x".to_owned(), axes, name: None };
        let request = AssetRequest { files: vec![file], settings: settings() };
        request.check().unwrap();
        // Both neighbours of the range, and both ends of the type.
        for mesh_gaussians in [0, 999, 1_000_001, u32::MAX] {
            let settings = AssetSettings { mesh_gaussians, ..settings() };
            let error = AssetRequest { settings, ..request.clone() }.check().unwrap_err();
            assert!(error.to_string().starts_with("gaussians is "), "{error}");
        }
        let settings = AssetSettings { name: "../x".to_owned(), ..settings() };
        let error = AssetRequest { settings, ..request.clone() }.check().unwrap_err();
        assert!(matches!(error, PushError::InvalidName { field: "name", .. }), "{error}");
        let error = AssetRequest { files: Vec::new(), ..request }.check().unwrap_err();
        assert!(error.to_string().starts_with("files is 0 entries"), "{error}");
    }
}
