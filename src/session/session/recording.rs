//! What a session writes to its episodes' files.

use wildcity_scene::Rig;

use super::Session;
use crate::blocking::run_blocking;
use crate::episode::{Episode, Outcome};
use crate::error::SessionError;
use crate::observe::builder::finish::RenderedObservation;
use crate::options::PixelMaps;
use crate::record::error::RecordError;
use crate::record::format::{
    BUILD, EpisodeHeader, FrameRecord, FrameRequest, Line, RecordedOrigin, RecordedOutputs,
    RecordedSettings, RecordedVersion,
};
use crate::record::recorder::{NewFile, Recorder};
use crate::scenario::EpisodeTraffic;
use crate::state::{PinnedVersion, SessionSettings};

impl Session {
    /// Appends a frame to the episode's file. The first frame of an episode creates the file.
    pub(super) async fn record(&mut self, frame: FrameRecord) -> Result<(), SessionError> {
        let frame = Line::Frame(frame);
        match self.recorder.clone() {
            Some(recorder) => {
                let version = self.version_switched.then(|| self.version_line());
                append(recorder, version.into_iter().chain([frame]).collect()).await?;
            }
            None => {
                let scenario = scenario_hash(self.state.traffic.as_ref());
                let origin = self.origin.clone();
                let file = self
                    .create_file(&self.version, origin, scenario, &self.state.episode, frame)
                    .await?;
                self.recorder = Some(file.recorder);
                self.episode_number = file.number;
            }
        }
        self.version_switched = false;
        Ok(())
    }

    /// The record of a rendered observation, without the command that led there.
    pub(super) fn frame_record(
        &self,
        request: FrameRequest,
        episode: &Episode,
        rendered: &RenderedObservation,
    ) -> FrameRecord {
        let RenderedObservation { observation, captures, hashes, .. } = rendered;
        let all_cameras = self.settings.layout.cameras().len();
        let mut cameras: Vec<_> = captures.iter().map(|capture| capture.cameras.clone()).collect();
        if cameras.iter().all(|of_pose| of_pose.len() == all_cameras) {
            cameras.clear();
        }
        FrameRecord {
            request,
            step: episode.step(),
            time_us: episode.time_us(),
            poses: captures.iter().map(|capture| capture.world_from_rig).collect(),
            cameras,
            command: None,
            steps: 1,
            times_us: Vec::new(),
            notes: None,
            terminated: episode.terminated(),
            frame_hash: observation.frame_hash.to_hex().to_string(),
            images: hashes.iter().map(|hash| hash.to_hex().to_string()).collect(),
        }
    }

    /// The line after which frames are rendered from another version of the twin.
    fn version_line(&self) -> Line {
        let version = &self.resident().version;
        Line::Version(RecordedVersion {
            step: self.state.episode.step(),
            version: version.number,
            version_hash: version.hash.clone(),
            profile: self.version.profile,
            profile_hash: self.version.profile_hash.to_hex().to_string(),
        })
    }

    /// Creates the file of an episode, with its header and its first frame. `episode` is the state before that
    /// frame's step.
    pub(super) async fn create_file(
        &self,
        pinned: &PinnedVersion,
        origin: Option<RecordedOrigin>,
        scenario: Option<String>,
        episode: &Episode,
        first_frame: Line,
    ) -> Result<NewFile, SessionError> {
        let version = &pinned.resident.version;
        let settings = &self.settings;
        let PixelMaps { depth, opacity, normals, instances } = settings.layout.maps();
        let cameras = settings.layout.cameras().to_vec();
        let header = EpisodeHeader {
            format: EpisodeHeader::FORMAT,
            build: BUILD.to_owned(),
            session: self.name.clone(),
            twin: version.manifest.twin.clone(),
            version: version.number,
            version_hash: version.hash.clone(),
            profile: pinned.profile,
            profile_hash: pinned.profile_hash.to_hex().to_string(),
            backend: self.engine.backend().to_owned(),
            backend_detail: self.engine.backend_detail(),
            rig: Rig { name: settings.rig_name.clone(), cameras },
            outputs: RecordedOutputs {
                encoding: settings.layout.encoding(),
                depth,
                opacity,
                normals,
                instances,
            },
            seed: episode.seed(),
            dynamics: episode.ego().dynamics(),
            start: episode.world_from_rig(),
            dt_us: settings.dt_us,
            settings: recorded_settings(settings, pinned.coverage.is_some()),
            state: (!episode.is_start_alone()).then(|| episode.clone()),
            origin,
            scenario,
        };
        let dir = self.engine.episodes().to_owned();
        let name = self.name.clone();
        let first_number = self.episode_number + 1;
        let lines = [Line::Episode(Box::new(header)), first_frame];
        let created =
            run_blocking(move || logged(Recorder::create(&dir, &name, first_number, &lines)));
        Ok(created.await??)
    }

    /// Writes the last line of the episode's file. A failure is only logged: the episode is over either
    /// way.
    pub(super) async fn end_recording(&mut self, outcome: Outcome) {
        let Some(recorder) = self.recorder.take() else { return };
        if let Err(error) =
            append(recorder, vec![Line::End(self.state.episode.summary(outcome))]).await
        {
            tracing::warn!(session = self.name, "the episode's summary was not recorded: {error}");
        }
    }
}

/// BLAKE3 of an episode's scenario, in hex.
pub(super) fn scenario_hash(traffic: Option<&EpisodeTraffic>) -> Option<String> {
    traffic.map(|traffic| traffic.loaded().hash.clone())
}

/// The settings that the header does not have otherwise; `None` if all are the defaults.
fn recorded_settings(settings: &SessionSettings, trust: bool) -> Option<RecordedSettings> {
    let recorded = RecordedSettings {
        profile_overrides: settings.profile_overrides.clone(),
        schedule: settings.layout.schedule().clone(),
        trust,
        warm_up_us: settings.warm_up_us,
    };
    let cameras = settings.layout.cameras().len();
    (recorded != RecordedSettings::default_of(cameras, settings.dt_us)).then_some(recorded)
}

async fn append(recorder: Recorder, lines: Vec<Line>) -> Result<(), SessionError> {
    Ok(run_blocking(move || logged(recorder.append(&lines))).await??)
}

/// Logs a failure: it concerns the operator, and the client may not tell him.
fn logged<T>(recorded: Result<T, RecordError>) -> Result<T, RecordError> {
    recorded.inspect_err(|error| tracing::error!("{error}"))
}
