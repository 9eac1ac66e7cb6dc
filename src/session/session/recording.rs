//! What a session writes to its episodes' files.

use super::Session;
use crate::episode::{Episode, Outcome};
use crate::error::SessionError;
use crate::observe::builder::RenderedObservation;
use crate::options::PixelMaps;
use crate::record::format::{
    BUILD, EpisodeHeader, FrameRecord, FrameRequest, Line, RecordedOutputs, RecordedVersion,
    Recorder,
};
use wildcity_scene::Rig;

impl Session {
    /// Writes what was rendered to the episode's file, which begins with its first frame.
    pub(crate) async fn record(&mut self, frame: FrameRecord) -> Result<(), SessionError> {
        let line = Line::Frame(frame);
        match self.recorder.clone() {
            Some(recorder) => {
                let version = self.switched.then(|| self.version_line());
                append(recorder, version.into_iter().chain([line]).collect()).await?;
            }
            None => {
                let (recorder, number) = self.begin_recording(&self.episode, line).await?;
                (self.recorder, self.episode_number) = (Some(recorder), number);
            }
        }
        self.switched = false;
        Ok(())
    }

    /// Says what was rendered.
    pub(crate) fn frame_line(
        &self,
        request: FrameRequest,
        episode: &Episode,
        drawing: &RenderedObservation,
    ) -> FrameRecord {
        let RenderedObservation { frame, shots, hashes, .. } = drawing;
        let all = self.layout.cameras().len();
        let mut cameras: Vec<_> = shots.iter().map(|shot| shot.cameras.clone()).collect();
        if cameras.iter().all(|of_pose| of_pose.len() == all) {
            cameras.clear();
        }
        FrameRecord {
            request,
            step: episode.step(),
            time_us: episode.time_us(),
            poses: shots.iter().map(|shot| shot.world_from_rig).collect(),
            cameras,
            command: None,
            terminated: episode.terminated(),
            frame_hash: frame.frame_hash.to_hex().to_string(),
            images: hashes.iter().map(|hash| hash.to_hex().to_string()).collect(),
        }
    }

    /// Says that what follows is of this version.
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

    /// Begins the file of an episode that has not moved yet, with its first frame.
    pub(crate) async fn begin_recording(
        &self,
        episode: &Episode,
        first_frame: Line,
    ) -> Result<(Recorder, u64), SessionError> {
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
        let (dir, name) = (self.engine.episodes().to_owned(), self.name.clone());
        let (first_number, lines) =
            (self.episode_number + 1, [Line::Episode(Box::new(header)), first_frame]);
        let created = tokio::task::spawn_blocking(move || {
            Recorder::create(&dir, &name, first_number, &lines)
        });
        let created = created.await;
        Ok(created.map_err(|_| SessionError::Crashed)??)
    }

    /// Writes the last line. The episode is over either way: a failure is only logged.
    pub(crate) async fn finish(&mut self, outcome: Outcome) {
        let Some(recorder) = self.recorder.take() else { return };
        if let Err(error) = append(recorder, vec![Line::End(self.episode.summary(outcome))]).await {
            tracing::warn!(session = self.name, "the episode's summary is missing: {error}");
        }
    }
}

async fn append(recorder: Recorder, lines: Vec<Line>) -> Result<(), SessionError> {
    let appended = tokio::task::spawn_blocking(move || recorder.append(&lines)).await;
    Ok(appended.map_err(|_| SessionError::Crashed)??)
}
