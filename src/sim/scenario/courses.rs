//! The lines that actors and routes of a scenario follow.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::DVec3;

use super::around::{Surroundings, checked_points, drive_named};
use super::error::FileError;
use crate::Ground;
use crate::traffic::Course;

/// The lines of a scenario; each recorded drive is one course, which its actors share.
pub(super) struct Courses<'a> {
    around: &'a Surroundings<'a>,
    drives: BTreeMap<(String, bool), Arc<Course>>,
}

impl<'a> Courses<'a> {
    pub(super) fn new(around: &'a Surroundings<'a>) -> Self {
        Self { around, drives: BTreeMap::new() }
    }

    /// The line of a recorded drive, points or lanes, of which exactly one is given. `field` names
    /// the drive's field.
    pub(super) fn line(
        &mut self,
        field: &str,
        along: Option<&str>,
        points: Option<&[[f64; 3]]>,
        lanes: Option<&[String]>,
        reverse: bool,
    ) -> Result<Arc<Course>, FileError> {
        let none = || "leads nowhere: it needs two places at least 1 cm apart";
        let course = match (along, points, lanes) {
            (Some(name), None, None) => {
                // The two directions of a drive are two courses.
                let key = (name.to_owned(), reverse);
                if let Some(course) = self.drives.get(&key) {
                    return Ok(course.clone());
                }
                let drive = drive_named(field, name, self.around.drives)?;
                let ahead =
                    Course::from_drive(drive).ok_or_else(|| FileError::new(field, none()))?;
                let course = Arc::new(if reverse { ahead.reversed() } else { ahead });
                self.drives.insert(key, course.clone());
                return Ok(course);
            }
            (None, Some(points), None) => {
                let points_m = checked_points("points", points)?;
                Course::from_points(&points_m, &self.around.ground())
                    .ok_or_else(|| FileError::new("points", none()))?
            }
            (None, None, Some(ids)) => {
                let map = self.around.map.ok_or_else(|| {
                    FileError::new("lanes", "need a map: write \"map\": {\"file\": ..}")
                })?;
                let surface = map.lane_surface(ids).map_err(|(index, message)| {
                    FileError::new(format!("lanes[{index}]"), message)
                })?;
                // The middle lines one after the other. Where one lane ends at the start of the
                // next, `Course` drops the repeated point.
                let points = surface.lines().flatten();
                let points_m: Vec<DVec3> = points.map(|point| point.position_m).collect();
                // Not of the drives nearby, which may be of another level.
                let ground = Ground::from_drives(&[]).and_lanes(Some(&surface));
                Course::from_points(&points_m, &ground)
                    .ok_or_else(|| FileError::new("lanes", none()))?
            }
            _ => {
                let message = format!("write exactly one of {field}, points and lanes");
                return Err(FileError::new(field, message));
            }
        };
        // A cached drive has returned above.
        Ok(Arc::new(if reverse { course.reversed() } else { course }))
    }
}
