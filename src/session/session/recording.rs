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
    BUILD, EpisodeHeader, FrameRecord, FrameRequest, Line, RecordedOutputs, RecordedVersion,
};
use crate::record::recorder::{NewFile, Recorder};

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
                let file = self.create_file(&self.episode, frame).await?;
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
        let all_cameras = self.layout.cameras().len();
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
            terminated: episode.terminated(),
            frame_hash: observation.frame_hash.to_hex().to_string(),
            images: hashes.iter().map(|hash| hash.to_hex().to_string()).collect(),
        }
    }

    /// The line after which frames are rendered from another version of the twin.
    fn version_line(&self) -> Line {
        let version = &self.resident().version;
        Line::Version(RecordedVersion {
            step: self.episode.step(),
            version: version.number,
            version_hash: version.hash.clone(),
            profile: self.profile,
            profile_hash: self.profile_hash.to_hex().to_string(),
        })
    }

    /// Creates the file of an episode that has not moved yet, with its header and its first frame.
    pub(super) async fn create_file(
        &self,
        episode: &Episode,
        first_frame: Line,
    ) -> Result<NewFile, SessionError> {
        let version = &self.resident().version;
        let PixelMaps { depth, opacity, normals } = self.layout.maps();
        let cameras = self.layout.cameras().to_vec();
        let header = EpisodeHeader {
            format: EpisodeHeader::FORMAT,
            build: BUILD.to_owned(),
            session: self.name.clone(),
            twin: version.manifest.twin.clone(),
            version: version.number,
            version_hash: version.hash.clone(),
            profile: self.profile,
            profile_hash: self.profile_hash.to_hex().to_string(),
            backend: self.engine.backend().to_owned(),
            backend_detail: self.engine.backend_detail(),
            rig: Rig { name: self.rig_name.clone(), cameras },
            outputs: RecordedOutputs { encoding: self.layout.encoding(), depth, opacity, normals },
            seed: episode.seed(),
            dynamics: self.dynamics,
            start: episode.world_from_rig(),
            dt_us: self.dt_us,
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
        if let Err(error) = append(recorder, vec![Line::End(self.episode.summary(outcome))]).await {
            tracing::warn!(session = self.name, "the episode's summary was not recorded: {error}");
        }
    }
}

async fn append(recorder: Recorder, lines: Vec<Line>) -> Result<(), SessionError> {
    Ok(run_blocking(move || logged(recorder.append(&lines))).await??)
}

/// Logs a failure: it concerns the operator, and the client may not tell him.
fn logged<T>(recorded: Result<T, RecordError>) -> Result<T, RecordError> {
    recorded.inspect_err(|error| tracing::error!("{error}"))
}
