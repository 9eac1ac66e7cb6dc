//! The WGSL source of each shader. `#import NAME` lines are replaced by the file of that name; this
//! one directive is the whole preprocessor. A NAME in capitals is a placeholder for one of several
//! files, and each choice makes a variant of the shader.

use std::sync::Arc;

/// The linked sources of all shaders. Clones share them.
#[derive(Clone, Debug)]
pub struct Shaders {
    linked: Arc<Vec<Linked>>,
}

/// A shader with all its imports.
#[derive(Clone, Debug)]
struct Linked {
    name: &'static str,
    source: String,
}

/// A shader before it is linked.
#[derive(Clone, Copy, Debug)]
struct Variant {
    name: &'static str,
    /// The file to start with.
    file: &'static str,
    /// The file for each placeholder.
    choices: &'static [Choice],
}

/// The file that replaces a placeholder.
#[derive(Clone, Copy, Debug)]
struct Choice {
    placeholder: &'static str,
    file: &'static str,
}

const fn choice(placeholder: &'static str, file: &'static str) -> Choice {
    Choice { placeholder, file }
}

const fn variant(name: &'static str, file: &'static str, choices: &'static [Choice]) -> Variant {
    Variant { name, file, choices }
}

/// A shader without placeholders.
const fn plain(name: &'static str) -> Variant {
    Variant { name, file: name, choices: &[] }
}

const PINHOLE: Choice = choice("PROJECTION", "pinhole");
const UNSCENTED: Choice = choice("PROJECTION", "unscented");
const NO_ACTORS: Choice = choice("ACTORS", "no_actors");
const ACTORS: Choice = choice("ACTORS", "actors");
const INSTANCES: Choice = choice("INSTANCES", "instances");
const OWNERS: Choice = choice("INSTANCES", "owners");
const NO_INSTANCES: Choice = choice("INSTANCES", "no_instances");
const BACKGROUND: Choice = choice("BACKGROUND", "background");
const NO_BACKGROUND: Choice = choice("BACKGROUND", "no_background");
const MAP: Choice = choice("SKY", "sky_map");
const NETWORK: Choice = choice("SKY", "sky_network");
const BALLOTS: Choice = choice("BALLOTS", "ballots");
const BALLOTS_EMULATED: Choice = choice("BALLOTS", "ballots_emulated");
const RAY_PINHOLE: Choice = choice("RAYS", "ray_pinhole");
const RAY_LENS: Choice = choice("RAYS", "ray_lens");

const VARIANTS: &[Variant] = &[
    variant("project", "project", &[PINHOLE, NO_ACTORS]),
    variant("project_unscented", "project", &[UNSCENTED, NO_ACTORS]),
    variant("project_actors", "project", &[PINHOLE, ACTORS]),
    variant("project_unscented_actors", "project", &[UNSCENTED, ACTORS]),
    plain("scan"),
    plain("plan"),
    plain("sort"),
    variant("sort_ballots", "sort_ballots", &[BALLOTS]),
    variant("sort_ballots_emulated", "sort_ballots", &[BALLOTS_EMULATED]),
    plain("bin"),
    plain("ranges"),
    plain("expand"),
    plain("long_tiles"),
    plain("rasterize_long"),
    variant("rasterize", "rasterize", &[NO_INSTANCES, NO_BACKGROUND]),
    variant("rasterize_map", "rasterize", &[NO_INSTANCES, BACKGROUND, MAP, RAY_PINHOLE]),
    variant("rasterize_map_lens", "rasterize", &[NO_INSTANCES, BACKGROUND, MAP, RAY_LENS]),
    variant("rasterize_network", "rasterize", &[NO_INSTANCES, BACKGROUND, NETWORK, RAY_PINHOLE]),
    variant("rasterize_network_lens", "rasterize", &[NO_INSTANCES, BACKGROUND, NETWORK, RAY_LENS]),
    variant("instances", "rasterize", &[INSTANCES, NO_BACKGROUND]),
    variant("instances_map", "rasterize", &[INSTANCES, BACKGROUND, MAP, RAY_PINHOLE]),
    variant("instances_map_lens", "rasterize", &[INSTANCES, BACKGROUND, MAP, RAY_LENS]),
    variant("instances_network", "rasterize", &[INSTANCES, BACKGROUND, NETWORK, RAY_PINHOLE]),
    variant("instances_network_lens", "rasterize", &[INSTANCES, BACKGROUND, NETWORK, RAY_LENS]),
    variant("owners", "rasterize", &[OWNERS, NO_BACKGROUND]),
    variant("owners_map", "rasterize", &[OWNERS, BACKGROUND, MAP, RAY_PINHOLE]),
    variant("owners_map_lens", "rasterize", &[OWNERS, BACKGROUND, MAP, RAY_LENS]),
    variant("owners_network", "rasterize", &[OWNERS, BACKGROUND, NETWORK, RAY_PINHOLE]),
    variant("owners_network_lens", "rasterize", &[OWNERS, BACKGROUND, NETWORK, RAY_LENS]),
    plain("splat_owners"),
    plain("rasterize_gradient"),
    plain("gather"),
    variant("project_gradient", "project_gradient", &[PINHOLE, NO_ACTORS]),
    variant("project_gradient_actors", "project_gradient", &[PINHOLE, ACTORS]),
    plain("lidar"),
    plain("roofline"),
];

/// Name and content of the files in `shaders` and `shaders/shared`.
const FILES: &[(&str, &str)] = &[
    ("actors", include_str!("../../../shaders/actors.wgsl")),
    ("angle", include_str!("../../../shaders/shared/angle.wgsl")),
    ("appearance", include_str!("../../../shaders/appearance.wgsl")),
    ("background", include_str!("../../../shaders/background.wgsl")),
    ("ballots", include_str!("../../../shaders/ballots.wgsl")),
    ("ballots_emulated", include_str!("../../../shaders/ballots_emulated.wgsl")),
    ("bin", include_str!("../../../shaders/bin.wgsl")),
    ("constants", include_str!("../../../shaders/shared/constants.wgsl")),
    ("expansion", include_str!("../../../shaders/expansion.wgsl")),
    ("expand", include_str!("../../../shaders/expand.wgsl")),
    ("has_samples", include_str!("../../../shaders/shared/has_samples.wgsl")),
    ("halved_by", include_str!("../../../shaders/shared/halved_by.wgsl")),
    ("instances", include_str!("../../../shaders/instances.wgsl")),
    ("four_pixels", include_str!("../../../shaders/shared/four_pixels.wgsl")),
    ("gather", include_str!("../../../shaders/gather.wgsl")),
    ("layout", include_str!("../../../shaders/shared/layout.wgsl")),
    ("lens", include_str!("../../../shaders/lens.wgsl")),
    ("lidar", include_str!("../../../shaders/lidar.wgsl")),
    ("long_tiles", include_str!("../../../shaders/long_tiles.wgsl")),
    ("macro_tile", include_str!("../../../shaders/shared/macro_tile.wgsl")),
    ("math", include_str!("../../../shaders/shared/math.wgsl")),
    ("no_actors", include_str!("../../../shaders/shared/no_actors.wgsl")),
    ("no_instances", include_str!("../../../shaders/shared/no_instances.wgsl")),
    ("no_background", include_str!("../../../shaders/shared/no_background.wgsl")),
    ("owners", include_str!("../../../shaders/owners.wgsl")),
    ("pinhole", include_str!("../../../shaders/pinhole.wgsl")),
    ("plan", include_str!("../../../shaders/plan.wgsl")),
    ("prefix", include_str!("../../../shaders/shared/prefix.wgsl")),
    ("project", include_str!("../../../shaders/project.wgsl")),
    ("project_gradient", include_str!("../../../shaders/project_gradient.wgsl")),
    ("ranges", include_str!("../../../shaders/ranges.wgsl")),
    ("rasterize", include_str!("../../../shaders/rasterize.wgsl")),
    ("rasterize_gradient", include_str!("../../../shaders/rasterize_gradient.wgsl")),
    ("rasterize_long", include_str!("../../../shaders/rasterize_long.wgsl")),
    ("ray_lens", include_str!("../../../shaders/ray_lens.wgsl")),
    ("ray_pinhole", include_str!("../../../shaders/ray_pinhole.wgsl")),
    ("resolve", include_str!("../../../shaders/resolve.wgsl")),
    ("roofline", include_str!("../../../shaders/roofline.wgsl")),
    ("samples", include_str!("../../../shaders/samples.wgsl")),
    ("scan", include_str!("../../../shaders/scan.wgsl")),
    ("sky_map", include_str!("../../../shaders/sky_map.wgsl")),
    ("sky_network", include_str!("../../../shaders/sky_network.wgsl")),
    ("sort", include_str!("../../../shaders/sort.wgsl")),
    ("tile_blocks", include_str!("../../../shaders/shared/tile_blocks.wgsl")),
    ("splat_batch", include_str!("../../../shaders/shared/splat_batch.wgsl")),
    ("splat_owners", include_str!("../../../shaders/splat_owners.wgsl")),
    ("splat_slot", include_str!("../../../shaders/shared/splat_slot.wgsl")),
    ("splat_sums", include_str!("../../../shaders/shared/splat_sums.wgsl")),
    ("sort_ballots", include_str!("../../../shaders/sort_ballots.wgsl")),
    ("touch_batch", include_str!("../../../shaders/shared/touch_batch.wgsl")),
    ("unscented", include_str!("../../../shaders/unscented.wgsl")),
];

impl Default for Shaders {
    fn default() -> Self {
        let linked = VARIANTS.iter().map(|variant| {
            let mut source = String::new();
            append(variant.file, variant.choices, &mut Vec::new(), &mut source);
            Linked { name: variant.name, source }
        });
        Self { linked: Arc::new(linked.collect()) }
    }
}

impl Shaders {
    /// Name and linked source of every variant of a shader.
    pub fn stages(&self) -> impl Iterator<Item = (&'static str, &str)> {
        self.linked.iter().map(|linked| (linked.name, linked.source.as_str()))
    }

    /// These shaders with the first `original` text of a variant replaced, or `None` if the variant
    /// does not contain it. Tests break a shader with it and check that the fault is detected.
    pub fn with_mutation(
        mut self,
        shader: &str,
        original: &str,
        replacement: &str,
    ) -> Option<Self> {
        // Clones share the sources; these are copied first, so that only this one is broken.
        let linked = Arc::make_mut(&mut self.linked);
        let Linked { source, .. } = linked.iter_mut().find(|linked| linked.name == shader)?;
        if !source.contains(original) {
            return None;
        }
        *source = source.replacen(original, replacement, 1);
        Some(self)
    }

    /// The linked source of a variant; empty if there is no such variant.
    pub(super) fn get(&self, shader: &str) -> &str {
        self.stages().find(|(name, _)| *name == shader).map_or("", |(_, source)| source)
    }
}

/// Appends a file with its imports, each file once. An import without a file is kept as it is, so
/// that the shader compiler reports it.
fn append(name: &str, choices: &[Choice], appended: &mut Vec<&'static str>, source: &mut String) {
    let Some((name, text)) = FILES.iter().find(|(file, _)| *file == name) else {
        source.push_str(&format!("#import {name}\n"));
        return;
    };
    if appended.contains(name) {
        return;
    }
    appended.push(name);
    for line in text.lines() {
        match line.strip_prefix("#import ") {
            Some(import) => {
                let choice = choices.iter().find(|choice| choice.placeholder == import);
                // A placeholder and a file are imported alike: a name without a choice is that of a
                // file.
                let file = choice.map_or(import, |choice| choice.file);
                append(file, choices, appended, source);
            }
            None => {
                source.push_str(line);
                source.push('\n');
            }
        }
    }
}
