//! The WGSL of each stage, with its `#import NAME` lines replaced by `shaders/shared/NAME.wgsl`
//! (`shaders/resolve.wgsl` for `resolve`, and likewise the skies). That one directive is the whole
//! preprocessor; `#import SKY` in `rasterize` stands for one of two, each a variant of the stage.

/// The linked sources of all stages.
#[derive(Clone, Debug)]
pub struct Shaders {
    stages: Vec<(&'static str, String)>,
}

impl Default for Shaders {
    fn default() -> Self {
        let stages = [
            ("project", include_str!("../../../shaders/project.wgsl")),
            ("scan", include_str!("../../../shaders/scan.wgsl")),
            ("plan", include_str!("../../../shaders/plan.wgsl")),
            ("sort", include_str!("../../../shaders/sort.wgsl")),
            ("bin", include_str!("../../../shaders/bin.wgsl")),
            ("ranges", include_str!("../../../shaders/ranges.wgsl")),
            ("expand", include_str!("../../../shaders/expand.wgsl")),
            ("roofline", include_str!("../../../shaders/roofline.wgsl")),
        ];
        let mut stages = stages.map(|(name, source)| (name, link(source))).to_vec();
        let rasterize = include_str!("../../../shaders/rasterize.wgsl");
        for (name, sky) in [("rasterize", "plain"), ("rasterize_sky", "sky_map")] {
            stages.push((name, link(&rasterize.replace("#import SKY", &format!("#import {sky}")))));
        }
        Self { stages }
    }
}

impl Shaders {
    /// Name and linked source of every stage.
    pub fn stages(&self) -> impl Iterator<Item = (&'static str, &str)> {
        self.stages.iter().map(|(name, source)| (*name, source.as_str()))
    }

    /// The same with the first `part` of a stage replaced, or `None` if the stage does not have it:
    /// how tests break a shader to see that it is noticed.
    pub fn with_slip(mut self, stage: &str, part: &str, slip: &str) -> Option<Self> {
        let (_, source) = self.stages.iter_mut().find(|(name, _)| *name == stage)?;
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

/// What `#import` can name.
const SHARED: &[(&str, &str)] = &[
    ("constants", include_str!("../../../shaders/shared/constants.wgsl")),
    ("layout", include_str!("../../../shaders/shared/layout.wgsl")),
    ("math", include_str!("../../../shaders/shared/math.wgsl")),
    ("prefix", include_str!("../../../shaders/shared/prefix.wgsl")),
    ("plain", include_str!("../../../shaders/shared/plain.wgsl")),
    ("appearance", include_str!("../../../shaders/appearance.wgsl")),
    ("behind", include_str!("../../../shaders/behind.wgsl")),
    ("resolve", include_str!("../../../shaders/resolve.wgsl")),
    ("sky_map", include_str!("../../../shaders/sky_map.wgsl")),
];

fn link(stage: &str) -> String {
    let source = |line| {
        let name = str::strip_prefix(line, "#import ");
        let shared = name.and_then(|name| SHARED.iter().find(|(shared, _)| *shared == name));
        // An unknown name stays, and the shader's compiler says where.
        shared.map_or_else(|| format!("{line}\n"), |(_, source)| link(source))
    };
    stage.lines().map(source).collect()
}
