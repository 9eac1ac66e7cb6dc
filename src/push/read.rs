//! Reads the files of a push and joins them to one scene.

use std::collections::{BTreeMap, BTreeSet};

use wildcity_scene::Gaussians;
use wildcity_scene::validate::{self, Field};
use wildcity_twin::ingest::{self, Antialiasing, IngestError, ListedFiles, ReadLimits};
use wildcity_twin::store::Version;

use crate::error::PushError;
use crate::frame::{Frame, twin_from_capture};
use crate::limits;
use crate::report::{FileReport, PushReport, Ranges};
use crate::request::RequestedFile;
use crate::source::{SourceAxes, SourceFile, SourceScene, read_scene};
use crate::status::Push;

/// The joined files of a push.
pub(crate) struct PushedScene {
    pub(crate) gaussians: Gaussians,
    /// BLAKE3 of each file, in hex.
    pub(crate) hashes: Vec<String>,
    /// The axes and scale of each file.
    pub(crate) options: Vec<String>,
    /// How the files say that they were trained; of different ones, that of the first with
    /// anti-aliasing.
    pub(crate) antialiasing: Option<Antialiasing>,
    pub(crate) report: PushReport,
}

impl PushedScene {
    /// Transforms the Gaussians to the frame of their base. The report contains their original
    /// frame.
    ///
    /// # Errors
    /// [`PushError::Content`]: a Gaussian is outside its bounds there.
    pub(crate) fn place_in_twin(
        &mut self,
        frame: Frame,
        base: Option<&Version>,
    ) -> Result<(), PushError> {
        self.report.frame = frame;
        self.report.is_aligned = base.map(twin_from_capture).transpose()?.flatten().is_some();
        let Some(alignment) = frame.alignment(base)? else { return Ok(()) };
        alignment.apply(&mut self.gaussians);
        // The report shows the values that would be stored, also if they are refused next.
        self.report.ranges = Ranges::from_gaussians(&self.gaussians);
        validate::check(&self.gaussians, &Field::twin_name).map_err(|bad| PushError::Content {
            reason: format!("in the axes of the twin, {bad}: check the scale of the files"),
            cells: Vec::new(),
        })?;
        self.options.push(format!("align={alignment}"));
        Ok(())
    }
}

/// Limits of the scene of one push.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ReadBounds {
    /// Bytes that each scene may unpack to.
    pub(crate) memory_bytes: u64,
    /// As [`ReadLimits::mesh_gaussians`].
    pub(crate) mesh_gaussians: u32,
    /// Gaussians of all files together.
    pub(crate) most_gaussians: u64,
    /// Remedy that the error gives if there are more.
    pub(crate) too_many_fix: &'static str,
    /// Whether Gaussians outside their bounds are left out.
    pub(crate) drop_bad: bool,
}

impl ReadBounds {
    /// The bounds of a push of a twin.
    pub(crate) fn for_twin(memory_bytes: u64, drop_bad: bool) -> Self {
        Self {
            memory_bytes,
            mesh_gaussians: ReadLimits::for_own_file().mesh_gaussians,
            most_gaussians: limits::PUSH_GAUSSIANS,
            too_many_fix: "push the scene in parts, some cells each",
            drop_bad,
        }
    }
}

/// Reads the files, converts them to the twin's axes, and joins them in the order of the request. A
/// file that another one names, such as a buffer of a glTF, is a part of that scene and not a
/// separate scene. `default_axes` has the axes of files for which they are not given. The report of
/// the push is set on success, and on failure if Gaussians are the reason.
pub(crate) fn read(
    push: &Push,
    requested: &[RequestedFile],
    files: &[SourceFile],
    default_axes: &SourceAxes,
    bounds: ReadBounds,
) -> Result<PushedScene, PushError> {
    let mut reader = Reader::new(push, files, default_axes, bounds);
    // Read scenes that may name other files first, so that the named files are not read as scenes.
    let names_others: Vec<bool> =
        files.iter().map(|file| ingest::may_name_others(&file.path).unwrap_or(false)).collect();
    // A file whose head cannot be read names no other; its own reader then reports why.
    for is_first in [true, false] {
        // A part may itself look like a scene, such as a description of a block that another one
        // names later: what is a part is known only when all scenes that name others were read.
        if !is_first {
            reader.drop_parts();
            reader.joins_at_once = true;
            reader.join_first()?;
        }
        for (index, requested) in requested.iter().enumerate() {
            if names_others[index] == is_first && !reader.parts.contains(&files[index].name) {
                reader.read(index, requested)?;
            }
        }
    }
    // A part that is not the last file leaves a gap in the order, at which joining stopped. Here
    // the rest is joined.
    reader.join_read(files.len())?;

    let mut scene = reader.scene;
    scene.antialiasing = common_antialiasing(&mut scene.report.files, &reader.antialiasing);
    scene.report.sh_degree = scene.gaussians.sh_degree;
    scene.report.ranges = Ranges::from_gaussians(&scene.gaussians);
    // The report is set before the check for emptiness, because its warnings may say why.
    push.set_report(scene.report.clone());
    if scene.gaussians.is_empty() {
        let reason = "the files hold no Gaussians: there is nothing to push".to_owned();
        return Err(PushError::Content { reason, cells: Vec::new() });
    }
    Ok(scene)
}

/// Reads files in any order, and joins them in the order of the request.
struct Reader<'a> {
    push: &'a Push,
    files: &'a [SourceFile],
    /// The files that a scene may name.
    listed: ListedFiles,
    default_axes: &'a SourceAxes,
    bounds: ReadBounds,
    total_bytes: u64,
    read_bytes: u64,
    /// Names of the files that are parts of a scene.
    parts: BTreeSet<String>,
    /// Scenes that are not joined yet, by index of their file.
    read: BTreeMap<usize, SourceScene>,
    /// How each scene of the report says that it was trained.
    antialiasing: Vec<Option<Antialiasing>>,
    /// Index of the next file to join.
    next: usize,
    /// Whether a scene is joined as soon as all scenes before it are.
    joins_at_once: bool,
    scene: PushedScene,
}

impl<'a> Reader<'a> {
    fn new(
        push: &'a Push,
        files: &'a [SourceFile],
        default_axes: &'a SourceAxes,
        bounds: ReadBounds,
    ) -> Self {
        // A name of two different files stands for neither.
        let mut listed = ListedFiles::new();
        let mut ambiguous = BTreeSet::new();
        for file in files {
            let known = listed.insert(file.name.clone(), file.path.clone());
            if known.is_some_and(|path| path != file.path) {
                ambiguous.insert(&file.name);
            }
        }
        listed.retain(|name, _| !ambiguous.contains(name));
        Self {
            push,
            files,
            listed,
            default_axes,
            bounds,
            // For the progress only, so that parts, which no reader counts, do no harm.
            total_bytes: files.iter().map(|file| file.bytes).sum(),
            read_bytes: 0,
            parts: BTreeSet::new(),
            read: BTreeMap::new(),
            antialiasing: Vec::new(),
            next: 0,
            joins_at_once: false,
            scene: PushedScene {
                gaussians: Gaussians::default(),
                hashes: Vec::with_capacity(files.len()),
                options: Vec::new(),
                antialiasing: None,
                report: PushReport::default(),
            },
        }
    }

    /// Reads one file, and joins it if all files before it are joined. If its content is refused
    /// for its Gaussians, they are in the report.
    fn read(&mut self, index: usize, requested: &RequestedFile) -> Result<(), PushError> {
        let file = &self.files[index];
        let name = &file.name;
        let before = self.read_bytes;
        let push = self.push;
        let total = self.total_bytes;
        let progress = &mut |done: u64, _| push.set_progress(before + done, total);
        let refused = |error: IngestError| PushError::Content {
            reason: format!("{name}: {error}"),
            cells: Vec::new(),
        };
        let limits = ReadLimits {
            listed: Some(&self.listed),
            memory_bytes: self.bounds.memory_bytes,
            stop: push.stop_flag().clone(),
            mesh_gaussians: self.bounds.mesh_gaussians,
            drop_bad: self.bounds.drop_bad,
            level: None,
        };
        let default = self.default_axes;
        let read = match read_scene(&file.path, &requested.axes, default, &limits, progress) {
            Ok(read) => read,
            // Only this error has something for the report: how many Gaussians are bad, and the
            // first of them.
            Err(IngestError::Values(bad)) => {
                let report = &mut self.scene.report;
                report.gaussians += bad.gaussians;
                report.files.push(FileReport {
                    name: name.clone(),
                    gaussians: bad.gaussians,
                    bad: bad.count,
                    first_bad: bad.first.clone(),
                    dropped: 0,
                    warnings: Vec::new(),
                    assumed: Vec::new(),
                });
                self.push.set_report(report.clone());
                return Err(PushError::Content {
                    reason: format!(
                        "{name}: {bad}; drop_bad (--drop-bad) leaves such Gaussians out"
                    ),
                    cells: Vec::new(),
                });
            }
            // The server's disk is at fault and not the content, so this is no refusal.
            Err(IngestError::File(cause)) => {
                return Err(PushError::Unreadable {
                    name: name.clone(),
                    reason: cause.to_string(),
                });
            }
            Err(error) => return Err(refused(error)),
        };
        self.read_bytes += file.bytes;
        self.parts.extend(read.parts.iter().cloned());
        self.read.insert(index, read);
        // Joining at once keeps one scene in memory beside the joined one, and not all of them.
        if self.joins_at_once {
            self.join_first()?;
        }
        Ok(())
    }

    /// Joins the scenes before the first one that is not read yet.
    fn join_first(&mut self) -> Result<(), PushError> {
        let is_missing = |index: &usize| {
            !self.read.contains_key(index) && !self.parts.contains(&self.files[*index].name)
        };
        let missing = (self.next..self.files.len()).find(is_missing);
        self.join_read(missing.unwrap_or(self.files.len()))
    }

    /// Drops the scenes that were read of files that are parts of others.
    fn drop_parts(&mut self) {
        let Self { files, parts, read, .. } = self;
        read.retain(|index, _| !parts.contains(&files[*index].name));
    }

    /// Joins the scenes that were read of the files before `end`.
    fn join_read(&mut self, end: usize) -> Result<(), PushError> {
        // The map is sorted by index, so that the scenes are joined in the order of the request,
        // which the version's bytes depend on.
        while let Some(entry) = self.read.first_entry().filter(|entry| *entry.key() < end) {
            let name = &self.files[*entry.key()].name;
            let SourceScene { gaussians, hash, options, notes, .. } = entry.remove();
            let scene = &mut self.scene;
            self.antialiasing.push(notes.antialiasing);
            let count = gaussians.len() as u64;
            scene.report.gaussians += count;
            scene.report.files.push(FileReport {
                name: name.clone(),
                gaussians: count,
                bad: 0,
                first_bad: Vec::new(),
                dropped: notes.dropped,
                warnings: notes.warnings,
                assumed: notes.assumed,
            });
            let total = scene.report.gaussians;
            // Before the copy, so that the memory of one scene too many is never reserved.
            check_count(name, total, &self.bounds)
                .inspect_err(|_| self.push.set_report(scene.report.clone()))?;
            if scene.gaussians.is_empty() {
                // Most pushes have one file, which needs no copy.
                scene.gaussians = gaussians;
            } else {
                scene.gaussians.append(&gaussians);
            }
            scene.hashes.push(hash);
            scene.options.extend(options);
        }
        self.next = self.next.max(end);
        Ok(())
    }
}

/// How the files say that they were trained. All Gaussians of a twin are drawn alike, so that files
/// which say something else than the one that counts get a warning.
fn common_antialiasing(
    files: &mut [FileReport],
    said: &[Option<Antialiasing>],
) -> Option<Antialiasing> {
    // A file without Gaussians was not trained, whatever it says.
    let all = || {
        let files = files.iter().zip(said).filter(|(file, _)| file.gaussians > 0);
        files.filter_map(|(file, said)| Some((file.name.clone(), said.as_ref()?)))
    };
    let is_on = |(_, said): &(String, &Antialiasing)| said.blur_px2.is_some();
    let (name, used) = all().find(is_on).or_else(|| all().next())?;
    for (file, said) in files.iter_mut().zip(said) {
        let own = said.as_ref().and_then(|said| said.blur_px2);
        if file.gaussians == 0 || own == used.blur_px2 {
            continue;
        }
        let about = said.as_ref().map_or("it does not say that it was", |said| &said.said_by);
        let trained = |blur: Option<f64>| {
            blur.map_or("without anti-aliasing".to_owned(), |blur| format!("with blur {blur}"))
        };
        file.warnings.push(format!(
            "trained {} ({about}), and {name} of the same push {} ({}): all Gaussians of a twin are drawn alike, so push \
             them to twins of their own, or train them alike",
            trained(own),
            trained(used.blur_px2),
            used.said_by,
        ));
    }
    Some(used.clone())
}

/// Refuses a push of too many Gaussians; `count` is how many it has with the file `name`.
fn check_count(name: &str, count: u64, bounds: &ReadBounds) -> Result<(), PushError> {
    let ReadBounds { most_gaussians: most, too_many_fix: fix, .. } = bounds;
    if count <= *most {
        return Ok(());
    }
    let reason = format!(
        "{name}: the push has {count} Gaussians with this file; at most {most} are accepted: {fix}"
    );
    Err(PushError::Content { reason, cells: Vec::new() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_that_were_trained_in_another_way_get_a_warning() {
        let report = |name: &str| FileReport {
            name: name.to_owned(),
            gaussians: 1,
            bad: 0,
            first_bad: Vec::new(),
            dropped: 0,
            warnings: Vec::new(),
            assumed: Vec::new(),
        };
        let says = |blur_px2: Option<f64>, said_by: &str| {
            Some(Antialiasing { blur_px2, said_by: said_by.to_owned() })
        };
        let warned = |said: &[Option<Antialiasing>]| {
            let mut files: Vec<FileReport> =
                ["a.ply", "b.ply"].iter().map(|name| report(name)).collect();
            let used = common_antialiasing(&mut files, said);
            (used, files.into_iter().map(|file| file.warnings.join("; ")).collect::<Vec<_>>())
        };
        let mip = says(Some(0.1), "comment mip");
        let default = says(None, "comment default");
        for plain in [None, default.clone()] {
            let (used, warnings) = warned(&[mip.clone(), plain.clone()]);
            assert_eq!((&used, &warnings[0][..]), (&mip, ""));
            assert!(warnings[1].contains("a.ply of the same push with blur 0.1"), "{warnings:?}");
            let (used, warnings) = warned(&[plain.clone(), mip.clone()]);
            assert_eq!((&used, &warnings[1][..]), (&mip, ""));
            assert!(warnings[0].starts_with("trained without"), "{warnings:?}");
            assert_eq!(warned(&[plain.clone(), plain.clone()]), (plain, vec![String::new(); 2]));
        }
        let (_, warnings) = warned(&[mip.clone(), says(Some(0.3), "antialiased 1")]);
        assert!(warnings[1].starts_with("trained with blur 0.3 (antialiased 1)"), "{warnings:?}");
        assert_eq!(warned(&[mip.clone(), mip.clone()]).1, ["", ""]);

        // A file without Gaussians does not count, whatever it says.
        let empty = FileReport { gaussians: 0, ..report("empty.ply") };
        let mut files = [empty, report("b.ply")];
        assert_eq!(common_antialiasing(&mut files, &[mip, default.clone()]), default);
        assert!(files.iter().all(|file| file.warnings.is_empty()), "{files:?}");
    }

    #[test]
    fn a_push_has_a_largest_size() {
        let bounds = ReadBounds::for_twin(1 << 30, false);
        assert!(check_count("a.ply", limits::PUSH_GAUSSIANS, &bounds).is_ok());
        let error = check_count("b.ply", limits::PUSH_GAUSSIANS + 1, &bounds).unwrap_err();
        assert!(error.is_refusal());
        // 250,000,000 are accepted, and the error names the count that is one more.
        let text = error.to_string();
        assert!(text.starts_with("b.ply") && text.contains("250000001"), "{text}");
    }
}
