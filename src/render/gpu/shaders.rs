//! The WGSL of each stage, with its `#import NAME` lines replaced by the file of that name. That one
//! directive is the whole preprocessor; a NAME in capitals stands for one of several files, and each choice
//! is a variant of the stage.

use std::sync::Arc;

/// The linked sources of all stages. A copy shares them.
#[derive(Clone, Debug)]
pub struct Shaders {
    stages: Arc<Vec<(&'static str, String)>>,
}

/// Name of a variant, its stage, and what its capitals stand for.
type Variant = (&'static str, &'static str, &'static [(&'static str, &'static str)]);

/// A stage without a choice is its own variant.
const VARIANTS: &[Variant] = &[
    ("project", "project", &[("SIGHT", "straight")]),
    ("project_bent", "project", &[("SIGHT", "bent")]),
    ("scan", "scan", &[]),
    ("plan", "plan", &[]),
    ("sort", "sort", &[]),
    ("bin", "bin", &[]),
    ("ranges", "ranges", &[]),
    ("expand", "expand", &[]),
    ("rasterize", "rasterize", &[("BEHIND", "plain")]),
    ("rasterize_map", "rasterize", &[BEHIND, MAP, STRAIGHT]),
    ("rasterize_map_bent", "rasterize", &[BEHIND, MAP, BENT]),
    ("rasterize_network", "rasterize", &[BEHIND, NETWORK, STRAIGHT]),
    ("rasterize_network_bent", "rasterize", &[BEHIND, NETWORK, BENT]),
    ("roofline", "roofline", &[]),
];

const BEHIND: (&str, &str) = ("BEHIND", "behind");
const MAP: (&str, &str) = ("SKY", "sky_map");
const NETWORK: (&str, &str) = ("SKY", "sky_network");
const STRAIGHT: (&str, &str) = ("LOOK", "look_straight");
const BENT: (&str, &str) = ("LOOK", "look_bent");

/// The files in `shaders` and `shaders/shared`.
const FILES: &[(&str, &str)] = &[
    ("angle", include_str!("../../../shaders/shared/angle.wgsl")),
    ("appearance", include_str!("../../../shaders/appearance.wgsl")),
    ("behind", include_str!("../../../shaders/behind.wgsl")),
    ("bent", include_str!("../../../shaders/bent.wgsl")),
    ("bin", include_str!("../../../shaders/bin.wgsl")),
    ("constants", include_str!("../../../shaders/shared/constants.wgsl")),
    ("expand", include_str!("../../../shaders/expand.wgsl")),
    ("layout", include_str!("../../../shaders/shared/layout.wgsl")),
    ("lens", include_str!("../../../shaders/lens.wgsl")),
    ("look_bent", include_str!("../../../shaders/look_bent.wgsl")),
    ("look_straight", include_str!("../../../shaders/look_straight.wgsl")),
    ("math", include_str!("../../../shaders/shared/math.wgsl")),
    ("plain", include_str!("../../../shaders/shared/plain.wgsl")),
    ("plan", include_str!("../../../shaders/plan.wgsl")),
    ("prefix", include_str!("../../../shaders/shared/prefix.wgsl")),
    ("project", include_str!("../../../shaders/project.wgsl")),
    ("ranges", include_str!("../../../shaders/ranges.wgsl")),
    ("rasterize", include_str!("../../../shaders/rasterize.wgsl")),
    ("resolve", include_str!("../../../shaders/resolve.wgsl")),
    ("roofline", include_str!("../../../shaders/roofline.wgsl")),
    ("scan", include_str!("../../../shaders/scan.wgsl")),
    ("sky_map", include_str!("../../../shaders/sky_map.wgsl")),
    ("sky_network", include_str!("../../../shaders/sky_network.wgsl")),
    ("sort", include_str!("../../../shaders/sort.wgsl")),
    ("straight", include_str!("../../../shaders/straight.wgsl")),
];

impl Default for Shaders {
    fn default() -> Self {
        let linked = VARIANTS.iter().map(|(name, stage, choices)| {
            let mut source = String::new();
            import(stage, choices, &mut Vec::new(), &mut source);
            (*name, source)
        });
        Self { stages: Arc::new(linked.collect()) }
    }
}

impl Shaders {
    /// Name and linked source of every variant of a stage.
    pub fn stages(&self) -> impl Iterator<Item = (&'static str, &str)> {
        self.stages.iter().map(|(name, source)| (*name, source.as_str()))
    }

    /// The same with the first `part` of a variant replaced, or `None` if it does not have it: how tests
    /// break a shader to see that it is noticed.
    pub fn with_mutation(mut self, stage: &str, part: &str, slip: &str) -> Option<Self> {
        let stages = Arc::make_mut(&mut self.stages);
        let (_, source) = stages.iter_mut().find(|(name, _)| *name == stage)?;
        if !source.contains(part) {
            return None;
        }
        *source = source.replacen(part, slip, 1);
        Some(self)
    }

    pub(super) fn get(&self, stage: &str) -> &str {
        self.stages().find(|(name, _)| *name == stage).map_or("", |(_, source)| source)
    }
}

/// Appends a file and, where it asks for them, those that are not there yet. What no file is called
/// stays, and the shader's compiler says where.
fn import(
    name: &str,
    choices: &[(&'static str, &'static str)],
    there: &mut Vec<&'static str>,
    source: &mut String,
) {
    let Some((name, text)) = FILES.iter().find(|(file, _)| *file == name) else {
        source.push_str(&format!("#import {name}\n"));
        return;
    };
    if there.contains(name) {
        return;
    }
    there.push(name);
    for line in text.lines() {
        match line.strip_prefix("#import ") {
            Some(asked) => {
                let chosen = choices.iter().find(|(capitals, _)| *capitals == asked);
                import(chosen.map_or(asked, |(_, file)| file), choices, there, source);
            }
            None => {
                source.push_str(line);
                source.push('\n');
            }
        }
    }
}
