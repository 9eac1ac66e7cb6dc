//! The scene, the cameras, and the render profile that the rendering commands share.

use std::path::{Path, PathBuf};

use anyhow::Context;

use wildcity_render::View;
use wildcity_scene::{RenderProfile, Scene};
use wildcity_session::{FrameScene, OpenScene};
use wildcity_twin::ingest::cameras::{self, ListedCamera};
use wildcity_twin::ingest::{self, ReadLimits, ReadScene};
use wildcity_twin::residency::Cache;

use super::directories::{TwinVersion, Twins};
use super::file_notes::{self, DropBad};
use super::profile_options::{LoadedProfile, ProfileOptions};
use super::progress;

/// A scene, a list of cameras, and changes of the render profile, on the command line.
#[derive(Debug, clap::Args)]
pub struct SceneSource {
    /// A scene file in any format that `wildcity import` reads, or the name of a twin: NAME, or
    /// NAME@NUMBER for an older version.
    #[arg(value_name = "SCENE")]
    scene: String,

    /// JSON list of cameras, or one camera per line, in the scene's own axes and metres: name,
    /// width, height, fx, fy, cx, cy (pixels), position (or position_ply), R_world_to_cam (rotation
    /// matrix by rows), and optionally near (metres).
    #[arg(long, value_name = "FILE")]
    cameras: PathBuf,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    profile: ProfileOptions,

    #[command(flatten)]
    bad: DropBad,
}

/// A scene and the images of it that a rendering command makes.
pub struct LoadedScene {
    source: OpenScene,
    pub shots: Vec<Shot>,
}

/// A named camera and the profile that it is rendered with.
pub struct Shot {
    pub name: String,
    pub view: View,
    pub profile: RenderProfile,
}

impl LoadedScene {
    /// The scene of a frame that has one shot.
    pub fn shot_scene(&self, shot: &Shot) -> anyhow::Result<FrameScene<'_>> {
        Ok(self.source.scene(&[shot.view], &shot.profile)?)
    }

    /// The scene of a frame that has all shots.
    pub fn whole_scene(&self) -> anyhow::Result<FrameScene<'_>> {
        let views: Vec<View> = self.shots.iter().map(|shot| shot.view).collect();
        let profile = self.shots.first().map_or(RenderProfile::DEFAULT, |shot| shot.profile);
        Ok(self.source.scene(&views, &profile)?)
    }
}

impl SceneSource {
    /// Reads the scene, the cameras, and the profile.
    pub fn open(&self) -> anyhow::Result<LoadedScene> {
        let listed =
            cameras::read(&self.cameras).with_context(|| format!("{}", self.cameras.display()))?;
        let changes = self.profile.load()?;
        let (source, profile) = open_scene(&self.scene, &self.twins, self.bad)?;
        let shots = listed
            .into_iter()
            .map(|camera| shot(camera, profile, &changes))
            .collect::<anyhow::Result<Vec<_>>>()?;
        Ok(LoadedScene { source, shots })
    }
}

/// A shot of a listed camera. Its own `near` overrides the scene's profile; the command line
/// overrides both.
fn shot(
    camera: ListedCamera,
    mut profile: RenderProfile,
    changes: &LoadedProfile,
) -> anyhow::Result<Shot> {
    let ListedCamera { name, camera, world_from_camera, near, .. } = camera;
    // The list overrides the scene, and the command line overrides both.
    profile.near = near.unwrap_or(profile.near);
    let profile = changes.apply(profile).with_context(|| format!("camera {name:?}"))?;
    Ok(Shot { name, view: View::new(camera, world_from_camera), profile })
}

/// Reads the scene of `SCENE`, with the profile that belongs to it: the twin's, or for a file
/// the default with what the file says.
pub(super) fn open_scene(
    scene: &str,
    twins: &Twins,
    DropBad { drop_bad }: DropBad,
) -> anyhow::Result<(OpenScene, RenderProfile)> {
    let path = Path::new(scene);
    // Pipes and devices count as files, so that the reader refuses them by name. A directory
    // does not: it may have the same name as a twin.
    if path.exists() && !path.is_dir() {
        let bar = progress::bytes("reading");
        let limits = ReadLimits { drop_bad, ..ReadLimits::for_own_file() };
        let read = ingest::read_limited(path, &limits, &mut progress::show(&bar));
        let ReadScene { gaussians, notes, .. } =
            file_notes::explained(read).with_context(|| format!("{}", path.display()))?;
        bar.finish_and_clear();
        file_notes::print(path, &notes)?;
        let scene = Scene::from_gaussians(&gaussians);
        return Ok((OpenScene::File(scene), notes.profile().apply(RenderProfile::default())?));
    }
    let named: TwinVersion = scene.parse().map_err(anyhow::Error::msg)?;
    let cache = Cache::new(twins.catalog()?);
    let resident = cache.open(&named.name, named.number).with_context(|| {
        format!("SCENE {scene:?} is not a file, and cannot be opened as a twin")
    })?;
    let profile = resident.version.manifest.profile;
    Ok((OpenScene::Twin(resident), profile))
}
