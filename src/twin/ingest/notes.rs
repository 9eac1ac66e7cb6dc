//! What a file says besides its Gaussians: how they were trained, their axes, and what was not
//! read.

use serde_json::{Map, Value};

use wildcity_scene::validate::{self, Field};
use wildcity_scene::{Gaussians, ProfileOverrides};

use super::{Axes, IngestError, ReadLimits};

/// Blur of trainers with opacity compensation that follow gsplat, in px².
pub(super) const BLUR_PX2: f64 = 0.3;
/// Blur of Brush's mode `mip` and of mip-splatting, in px².
pub(super) const BLUR_BRUSH_PX2: f64 = 0.1;
/// Names in one warning of what is not read.
const NAMED_SKIPPED: usize = 12;
/// Warnings of one scene; further ones are counted.
const MAX_WARNINGS: usize = 32;

/// What a scene says besides its Gaussians.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FileNotes {
    /// Whether the scene was trained with anti-aliasing, if it says so.
    pub antialiasing: Option<Antialiasing>,
    /// The axes that it is in.
    pub axes: Option<FileAxes>,
    /// What the scene says about its axes without giving them: warnings if nothing else does.
    pub axes_hints: Vec<String>,
    /// What was not read, or is drawn in another way than its authors may expect. Each names a part
    /// of the file.
    pub warnings: Vec<String>,
    /// What was taken where nothing was given, such as the axes of the twin's latest version.
    pub assumed: Vec<String>,
    /// Number of Gaussians outside their bounds that were left out.
    pub dropped: u64,
}

/// Training with or without opacity compensation.
#[derive(Clone, Debug, PartialEq)]
pub struct Antialiasing {
    /// Variance added to both axes of the screen covariance, in px²; none without compensation.
    pub blur_px2: Option<f64>,
    /// The part of the file that says so.
    pub said_by: String,
}

/// Axes that a file records, or that its format specifies.
#[derive(Clone, Debug, PartialEq)]
pub struct FileAxes {
    pub axes: Axes,
    /// The part of the file that says so, or the format.
    pub said_by: String,
    /// Whether only the specification of the format says so, to which not all programs keep.
    pub is_assumed: bool,
}

impl FileNotes {
    /// The fields of the render profile that the scene was trained with.
    pub fn profile(&self) -> ProfileOverrides {
        let mut fields = Map::new();
        if let Some(Antialiasing { blur_px2: Some(blur_px2), .. }) = self.antialiasing {
            fields.insert("antialiased".to_owned(), Value::Bool(true));
            fields.insert("blur".to_owned(), blur_px2.into());
        }
        ProfileOverrides::new(fields)
    }

    /// Adds a warning; each once, and only the first of many.
    fn warn(&mut self, warning: String) {
        let is_new = !self.warnings.contains(&warning);
        if is_new && self.warnings.len() < MAX_WARNINGS {
            self.warnings.push(warning);
        } else if is_new && self.warnings.len() == MAX_WARNINGS {
            // The last entry says that there were more. After it, nothing is added.
            self.warnings.push("further parts are not read".to_owned());
        }
    }
}

/// The reading of one scene, of one file or several.
pub(super) struct Reading {
    drop_bad: bool,
    /// The level of detail that is asked for, until a reader that has levels takes it.
    level: Option<u32>,
    notes: FileNotes,
}

impl Reading {
    /// The reading of a scene within limits.
    pub(super) fn new(limits: &ReadLimits<'_>) -> Self {
        Self { drop_bad: limits.drop_bad, level: limits.level, notes: FileNotes::default() }
    }

    /// # Errors
    /// [`IngestError::NoLevels`] if a level is asked for that no reader took.
    pub(super) fn into_notes(self) -> Result<FileNotes, IngestError> {
        match self.level {
            Some(level) => Err(IngestError::NoLevels { level }),
            None => Ok(self.notes),
        }
    }

    /// Takes the level of detail that is asked for.
    pub(super) fn take_level(&mut self) -> Option<u32> {
        self.level.take()
    }

    /// Whether Gaussians outside their bounds are left out.
    pub(super) fn drops_bad(&self) -> bool {
        self.drop_bad
    }

    /// Warns of a part of the file.
    pub(super) fn warn(&mut self, warning: String) {
        self.notes.warn(warning);
    }

    /// Warns of parts of the file that are not read.
    pub(super) fn warn_skipped(&mut self, kind: &str, names: &[&str]) {
        let mut named = names[..names.len().min(NAMED_SKIPPED)].join(", ");
        if names.len() > NAMED_SKIPPED {
            named += &format!(" and {} more", names.len() - NAMED_SKIPPED);
        }
        self.warn(format!("{kind} not read: {named}"));
    }

    /// The scene was trained with opacity compensation.
    pub(super) fn set_antialiased(&mut self, blur_px2: f64, said_by: String) {
        self.set_antialiasing(Some(blur_px2), said_by);
    }

    /// The scene was trained with opacity compensation, or without. The last part counts.
    pub(super) fn set_antialiasing(&mut self, blur_px2: Option<f64>, said_by: String) {
        let used = said_by.clone();
        let before = self.notes.antialiasing.replace(Antialiasing { blur_px2, said_by });
        if let Some(before) = before.filter(|before| before.blur_px2 != blur_px2) {
            let said_by = before.said_by;
            self.warn(format!("{said_by}: has no effect, because {used} says something else"));
        }
    }

    /// The scene consists of 2D Gaussians.
    pub(super) fn set_flat(&mut self, said_by: &str) {
        self.warn(format!(
            "{said_by}: these are 2D Gaussians; they are drawn as 3D ones of the smallest thickness"
        ));
    }

    /// The scene is in these axes.
    pub(super) fn set_axes(&mut self, axes: Axes, said_by: String) {
        self.notes.axes = Some(FileAxes { axes, said_by, is_assumed: false });
    }

    /// The scene is in the axes that its format specifies, unless it says others.
    pub(super) fn assume_axes(&mut self, axes: Axes, said_by: String) {
        let assumed = FileAxes { axes, said_by, is_assumed: true };
        self.notes.axes.get_or_insert(assumed);
    }

    /// Takes the axes of a part of the scene.
    pub(super) fn take_axes(&mut self) -> Option<FileAxes> {
        self.notes.axes.take()
    }

    /// The scene says something about its axes, but not what they are.
    pub(super) fn hint_axes(&mut self, hint: String) {
        if !self.notes.axes_hints.contains(&hint) && self.notes.axes_hints.len() < MAX_WARNINGS {
            self.notes.axes_hints.push(hint);
        }
    }

    /// Checks Gaussians; `name` gives the name of a field in the file. Infinite opacities and
    /// vanishing scales become the nearest values that can be stored.
    ///
    /// # Errors
    /// Gaussians outside their bounds, unless they are left out.
    pub(super) fn accept(
        &mut self,
        mut gaussians: Gaussians,
        name: &(dyn Fn(Field) -> String + Sync),
    ) -> Result<Gaussians, IngestError> {
        gaussians.clamp_activations();
        match validate::check(&gaussians, name) {
            Ok(()) => Ok(gaussians),
            Err(bad) if self.drop_bad => {
                self.notes.dropped += bad.count;
                let kept = (0..gaussians.len()).filter(|&i| validate::is_valid(&gaussians, i));
                Ok(gaussians.select(kept))
            }
            Err(bad) => Err(bad.into()),
        }
    }
}
