//! `--profile` and `--set`: changes of the render profile, the same on every command.

use std::path::{Path, PathBuf};

use anyhow::Context;

use crate::cli::limits;
use wildcity_scene::{ProfileOverrides, RenderProfile};
use wildcity_twin::ingest;

/// Changes of the render profile on the command line.
#[derive(Clone, Debug, Default, clap::Args)]
pub(super) struct ProfileOptions {
    /// Render profile: a JSON file of the fields to change, for example {"tau_px": 2.0}.
    /// `wildcity report` writes such files. Fields that it leaves out keep their values.
    #[arg(long, value_name = "FILE")]
    profile: Option<PathBuf>,

    /// Change one field of the render profile, for example --set near=0.2; may be given again, and
    /// overrides --profile. Fields: near, far (metres), blur (px²), antialiased (true or false),
    /// alpha_cap, alpha_cut, stop (0 to 1), tau_px (largest error of a level of detail, in pixels;
    /// 0 draws full detail), reach_m (draw distance in metres, or none), rays (splats, or exact:
    /// only the reference backend), shrink (images of at most 0.45 of their native sides: samples,
    /// or filter, which is faster and less exact), sky_error (0 evaluates the sky for every pixel;
    /// otherwise the largest colour error of the map that it is baked into), background (linear
    /// red,green,blue).
    #[arg(long = "set", value_name = "FIELD=VALUE")]
    settings: Vec<String>,
}

/// The changes, read from the file and the command line.
#[derive(Clone, Debug, Default)]
pub(super) struct LoadedProfile {
    from_file: ProfileOverrides,
    settings: Vec<String>,
}

impl ProfileOptions {
    /// Reads the file, if there is one.
    pub(super) fn load(&self) -> anyhow::Result<LoadedProfile> {
        let from_file = self.profile.as_deref().map(read_profile).transpose()?.unwrap_or_default();
        Ok(LoadedProfile { from_file, settings: self.settings.clone() })
    }
}

impl LoadedProfile {
    /// A profile with these changes: first those of the file, then those of `--set` in their order.
    pub(super) fn apply(&self, base: RenderProfile) -> anyhow::Result<RenderProfile> {
        let mut profile = self.from_file.apply(base).context("--profile")?;
        for setting in &self.settings {
            profile.set(setting).context("--set")?;
        }
        profile.check()?;
        Ok(profile)
    }
}

/// Reads the file of `--profile`, and checks that its fields exist and fit the default profile.
/// Whether they fit a twin's profile shows when they are applied to it.
pub(super) fn read_profile(path: &Path) -> anyhow::Result<ProfileOverrides> {
    let text = path.display().to_string();
    anyhow::ensure!(
        path.exists() || !text.contains('='),
        "--profile {text} is not a file: to change one field, write --set {text}"
    );
    let cannot = || format!("--profile {text}");
    let json = ingest::read_whole(path, limits::PROFILE_FILE_BYTES).with_context(cannot)?;
    let changes: ProfileOverrides = serde_json::from_slice(&json).with_context(cannot)?;
    // Applied to the default only to report a field out of range with the name of the file.
    changes.apply(RenderProfile::default()).with_context(cannot)?;
    Ok(changes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(profile: Option<&Path>, settings: &[&str]) -> ProfileOptions {
        let settings = settings.iter().map(|setting| (*setting).to_owned()).collect();
        ProfileOptions { profile: profile.map(Path::to_owned), settings }
    }

    #[test]
    fn set_overrides_the_file_and_both_override_the_scene() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("profile.json");
        std::fs::write(&file, r#"{"tau_px": 2.0, "stop": 0.004}"#).unwrap();
        let loaded = options(Some(&file), &["tau_px=4"]).load().unwrap();
        let base = RenderProfile { near: 0.2, ..RenderProfile::DEFAULT };
        let expected = RenderProfile { tau_px: 4.0, stop: 0.004, ..base };
        assert_eq!(loaded.apply(base).unwrap(), expected);
        assert_eq!(options(None, &[]).load().unwrap().apply(base).unwrap(), base);
    }

    #[test]
    fn errors_name_the_flag_and_the_fix() {
        let dir = tempfile::tempdir().unwrap();
        let bad = dir.path().join("bad.json");
        std::fs::write(&bad, r#"{"tau_px": -2}"#).unwrap();
        for (options, expected) in [
            (options(Some(Path::new("near=0.2")), &[]), "write --set near=0.2"),
            (options(Some(Path::new("missing.json")), &[]), "--profile missing.json"),
            (options(Some(&bad), &[]), "tau_px"),
            (options(None, &["fog=1"]), "--set: cannot read profile setting \"fog=1\""),
        ] {
            let applied = options.load().and_then(|loaded| loaded.apply(RenderProfile::DEFAULT));
            let message = format!("{:#}", applied.unwrap_err());
            assert!(message.contains(expected), "{message}");
        }
    }
}
