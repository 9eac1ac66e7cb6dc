//! Checks the cameras and steps of a suite before anything is driven.

use wildcity_scene::Rig;
use wildcity_session::limits as session;
use wildcity_sim::scenario::FileError;
use wildcity_twin::store::Version;

use crate::error::SuiteError;
use crate::file::SuiteFile;
use crate::limits;

/// Checks cameras, size and length of steps against a twin. A session would refuse them, once for
/// each episode.
///
/// # Errors
/// Names the suite's file and the field.
pub(crate) fn check(suite: &SuiteFile, version: &Version) -> Result<(), SuiteError> {
    let wrong = |cause| SuiteError::File { path: suite.path.clone(), cause };
    // A session takes this preset too where the twin has no rig.
    let rig = version.manifest.rig.clone().or_else(|| Rig::preset(session::RIG));
    check_step(suite).map_err(wrong)?;
    let twin = &version.manifest.twin;
    rig.map_or(Ok(()), |rig| check_rig(suite, &rig, twin).map_err(wrong))
}

fn check_step(suite: &SuiteFile) -> Result<(), FileError> {
    let accepted_us = session::DT_MIN_US..=limits::STEP_US;
    match suite.dt_us {
        Some(dt_us) if !accepted_us.contains(&dt_us) => {
            Err(FileError::new("dt_us", format!("{dt_us} µs; {accepted_us:?} µs are accepted")))
        }
        _ => Ok(()),
    }
}

fn check_rig(suite: &SuiteFile, rig: &Rig, twin: &str) -> Result<(), FileError> {
    let known: Vec<&str> = rig.cameras.iter().map(|camera| &*camera.name).collect();
    let of_rig = || known.iter().map(|&name| name.to_owned()).collect();
    let names = suite.cameras.clone().unwrap_or_else(of_rig);
    if names.is_empty() {
        return Err(FileError::new("cameras", "is empty; name a camera, or leave the field out"));
    }
    for (index, name) in names.iter().enumerate() {
        let field = format!("cameras[{index}]");
        let Some(camera) = rig.cameras.iter().find(|camera| camera.name == *name) else {
            // `names` is the suite's own list here: names of the rig are always found.
            let known = known.join(", ");
            let message = format!("{name:?} is no camera of twin {twin:?}, which has {known}");
            return Err(FileError::new(field, message));
        };
        // Twice the same camera would be twice the same image under one name.
        if names[..index].contains(name) {
            return Err(FileError::new(field, format!("{name:?} is there twice")));
        }
        if let Some([width_px, height_px]) = suite.size {
            let scaled = camera.scaled(width_px, height_px);
            scaled.map_err(|cause| {
                FileError::new("size", format!("[{width_px}, {height_px}]: {cause}"))
            })?;
        }
    }
    Ok(())
}
