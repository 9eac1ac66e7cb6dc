//! Options of `wildcity actor import` and `wildcity actor push`: how files become an asset.

use std::path::Path;

use wildcity_push::limits::{ACTOR_MESH_GAUSSIANS, ACTOR_MESH_GAUSSIANS_RANGE};
use wildcity_push::{AssetSettings, SourceAxes};
use wildcity_scene::rig::is_name;
use wildcity_scene::{ActorClass, RecordFormat};

/// How files become an asset.
#[derive(Debug, clap::Args)]
pub(super) struct AssetOptions {
    /// Name of the asset, made of a-z 0-9 . _ - [default: the file's name]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,

    /// Class of the actor: vehicle, pedestrian, bicycle or object.
    #[arg(long, default_value = "vehicle", value_parser = parse_class)]
    pub(super) class: ActorClass,

    /// Directions of the file's axes: a preset, or the 9 numbers of the matrix from the file's axes
    /// to the actor's (x forward, y left, z up), row by row. A glTF file that looks along +z, as
    /// the standard says, has '0 0 1 1 0 0 0 1 0'.
    #[arg(long, default_value = "identity", allow_hyphen_values = true)]
    pub(super) axes: String,

    /// Metres per unit of the file, applied after --axes.
    #[arg(long, default_value_t = 1.0, allow_negative_numbers = true)]
    pub(super) scale: f64,

    /// About how many flat Gaussians cover the triangles of a mesh, 1,000 to 1,000,000. Small
    /// triangles add more Gaussians.
    #[arg(
        long,
        value_name = "N",
        default_value_t = ACTOR_MESH_GAUSSIANS,
        value_parser = clap::value_parser!(u32).range(mesh_gaussians_range())
    )]
    gaussians: u32,

    /// Record format in which Gaussians are stored: f32 (exact), h52, q32 or q24.
    #[arg(long, value_name = "FORMAT", default_value_t)]
    pub(super) record: RecordFormat,
}

fn mesh_gaussians_range() -> std::ops::RangeInclusive<i64> {
    let (least, most) = ACTOR_MESH_GAUSSIANS_RANGE.into_inner();
    i64::from(least)..=i64::from(most)
}

impl AssetOptions {
    /// The settings of an asset of a file.
    pub(super) fn settings(&self, source: &Path) -> anyhow::Result<AssetSettings> {
        let name = match &self.name {
            Some(name) => name.clone(),
            None => default_name(source),
        };
        anyhow::ensure!(
            is_name(&name),
            "{name:?} cannot be the name of an actor: names have 1 to 64 of a-z 0-9 . _ - and do not start with .; \
             give --name"
        );
        let AssetOptions { class, gaussians, record, .. } = *self;
        Ok(AssetSettings { name, class, mesh_gaussians: gaussians, record })
    }

    /// The axes and unit of the file.
    pub(super) fn source_axes(&self) -> anyhow::Result<SourceAxes> {
        Ok(SourceAxes::parse(&self.axes, self.scale)?)
    }
}

/// The file's name without its extension, in small letters, with _ for other characters.
fn default_name(source: &Path) -> String {
    name_from(&source.file_stem().unwrap_or_default().to_string_lossy())
}

/// Text in small letters, with _ for characters that names do not have.
pub(super) fn name_from(text: &str) -> String {
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "._-".contains(c);
    text.to_lowercase().chars().map(|c| if allowed(c) { c } else { '_' }).collect()
}

pub(super) fn parse_class(text: &str) -> Result<ActorClass, String> {
    let found = ActorClass::ALL.into_iter().find(|class| class.name() == text);
    let names = ActorClass::ALL.map(ActorClass::name).join(", ");
    found.ok_or_else(|| format!("there is no class {text:?}; the classes are {names}"))
}
