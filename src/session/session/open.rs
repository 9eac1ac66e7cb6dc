//! Opening a session, and switching it to another version of the twin.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use glam::DVec3;
use serde_json::Value;
use tokio::time::Instant;

use wildcity_episode::scenario_line;
use wildcity_options::{
    ContactMode, Follow, ImagePart, Open, Outputs, RandomStart, Repair, RigChoice, Sensors, Start,
};
use wildcity_render::View;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::{
    Rig, RigCamera, RigLidar, UnreadRig, check_overlay_pixels, is_name, overlay_bytes,
};
use wildcity_scene::{Manifest, ProfileOverrides, RenderProfile, Trajectory};
use wildcity_sim::Dynamics;
use wildcity_sim::scenario::Scenario;
use wildcity_sim::traffic::EgoBox;
use wildcity_twin::residency::{
    FrameBytes, Reservation, Resident, RigExtent, SceneBytes, Urgency, Viewpoint,
};

use super::Session;
use crate::blocking::{Stop, run_blocking};
use crate::engine::Engine;
use crate::error::SessionError;
use crate::limits;
use crate::observe::encode::{ImageEncoding, PixelMaps};
use crate::observe::layout::ObservationLayout;
use crate::observe::schedule::Schedule;
use crate::observe::trust::TrainingCoverage;
use crate::prefetch::latest_task::LatestTask;
use crate::prefetch::recorded_drive::RecordedDrive;
use crate::repair::references::ReferenceViews;
use crate::repair::session_repair::SessionRepair;
use crate::scenario::{
    EpisodeScenario, EpisodeTraffic, LoadedScenario, ScenarioSource, SessionScenario,
};
use crate::sensors::settings::used;
use crate::snapshot::Snapshots;
use crate::start::{EpisodeStart, checked_pose};
use crate::state::{EpisodeState, PinnedVersion, SessionSettings};
use crate::viewpoint::rig_viewpoints;

impl Session {
    /// Opens a session, and reserves the memory for its worst frame. `seq`, `session` and
    /// `trajectory` of the options are for the answer, and not read.
    ///
    /// # Errors
    /// Names the first field of `options` that is invalid or cannot be satisfied. Nothing stays
    /// open then.
    pub async fn open(
        engine: Arc<Engine>,
        name: String,
        options: Open,
    ) -> Result<Self, SessionError> {
        let step_timeout = engine.step_timeout();
        // Off the threads that answer: a scenario of a megabyte is copied and checked.
        let mut asked = run_blocking(move || Asked::new(options, step_timeout)).await??;
        // Only then overlays, from whose headers the memory for them is reserved: a rig that is
        // refused decodes none.
        let chosen = decoded(&engine, asked.rig.take()).await?;

        // The version of the twin. Its Gaussians are loaded frame by frame.
        let resident = engine.open_version(asked.twin.clone(), asked.version).await?;

        // Read the scenario, whose ego section fills in what the request leaves open.
        let opened = match asked.scenario.take() {
            Some(source) => Some(OpenedScenario::read(&engine, &resident, source, &asked).await?),
            None => None,
        };
        let ego = AskedEgo::new(&asked, opened.as_ref());

        // Select the cameras. Scaling their overlays takes a second at worst.
        let rig = {
            let resident = resident.clone();
            let outputs = asked.outputs.clone();
            run_blocking(move || {
                let rig = select_cameras(&resident.version.manifest, chosen, &outputs)?;
                crop_and_scale(rig, &outputs)
            })
            .await??
        };
        // Counted as long as the settings exist, which the session shares with its branches.
        let overlays = engine.answer_budget().reserve(overlay_bytes(&rig.cameras))?;
        let extent = rig_extent(&rig.cameras, &rig.lidars);

        let repair = asked.load_repair(&engine, &rig.cameras).await?;
        let reports_actors = opened.is_some() && asked.outputs.actors.unwrap_or(false);
        let actors = opened
            .as_ref()
            .map(|opened| if reports_actors { opened.resolved().traffic.actors.len() } else { 0 });
        let layout = asked.layout(rig.cameras, rig.lidars, repair.as_deref(), actors)?;

        // Find where episodes start, and the recorded drive that the ego may follow from there.
        let manifest = &resident.version.manifest;
        let start = EpisodeStart::resolve(
            manifest,
            ego.start.as_ref(),
            ego.warm_up_us,
            ego.dynamics,
            asked.seed,
            opened.as_ref().and_then(|opened| opened.episode.loaded.lanes()),
        )?;
        let drive = drive_to_follow(&manifest.trajectories, ego.start.as_ref())
            .map(|drive| Arc::new(RecordedDrive::new(drive)));

        // The same seed as for the start, as in every later episode.
        let episode = start
            .episode(asked.seed, ego.dynamics, asked.dt_us)
            .with_sensors(layout.episode_sensors());
        let solid_ego = solid_ego(asked.contact, opened.as_ref().map(OpenedScenario::resolved));
        let (scenario, loaded) = match opened {
            Some(OpenedScenario { scenario, episode }) => (Some(scenario), Some(episode)),
            None => (None, None),
        };
        let settings = SessionSettings {
            profile_overrides: asked.profile,
            rig_name: rig.name,
            layout: Arc::new(layout),
            _overlays: overlays,
            dynamics: ego.dynamics,
            start,
            random_start: match ego.start {
                Some(Start::Random { random }) => Some(random),
                _ => None,
            },
            warm_up_us: ego.warm_up_us,
            dt_us: asked.dt_us,
            deadline: asked.deadline,
            drive,
            scenario,
            reports_actors,
            repair,
            contact: asked.contact,
            solid_ego,
            is_recorded: asked.is_recorded,
            follows_latest: asked.follows_latest,
        };

        // Prepare the version for its frames, and reserve the memory for the worst frame anywhere
        // in the twin.
        // An error about the coverage names the field that needs it.
        let coverage_for = match (asked.outputs.trust.unwrap_or(false), &settings.repair) {
            (true, _) => Some("outputs.trust"),
            (false, Some(_)) => Some("repair"),
            (false, None) => None,
        };
        let profile = resolve_profile(&engine, &resident, &settings)?;
        let version = prepare(&engine, resident.clone(), profile, coverage_for, solid_ego).await?;
        let frame = frame_bytes(&engine, &settings.layout, &version);
        // After the profile is known: coarser levels of detail need less memory.
        let scenes =
            Engine::scene_bytes(resident.clone(), extent, version.profile, settings.may_split());
        let reservation = resident.reserve_scenes(scenes.await?, frame)?;
        let references = load_references(&engine, &resident, &settings).await?;
        let version = version.with_references(references);

        let exposure_us = settings.layout.longest_exposure_us();
        let traffic = loaded.map(|EpisodeScenario { loaded, assets }| {
            EpisodeTraffic::at_start(loaded, assets, episode.ego(), exposure_us)
                .with_reach(episode.reach_us())
        });
        let state = EpisodeState { traffic, ..EpisodeState::at_start(episode) };
        Ok(Self::assembled(engine, name, Arc::new(settings), reservation, version, state))
    }

    /// A session in a state of an episode.
    pub(super) fn assembled(
        engine: Arc<Engine>,
        name: String,
        settings: Arc<SessionSettings>,
        reservation: Reservation,
        version: PinnedVersion,
        state: EpisodeState,
    ) -> Self {
        let dt_us = settings.dt_us;
        let session = Self {
            slot: engine.place_session(),
            engine,
            reservation,
            prefetch_task: LatestTask::default(),
            name,
            owner: String::new(),
            settings,
            version,
            state,
            snapshots: Snapshots::default(),
            origin: None,
            episode_number: 0,
            recorder: None,
            version_switched: false,
            not_followed: None,
            hint: Vec::new(),
            last_frame_at: Instant::now(),
            // Assume real time until a step shows the agent's pace.
            frame_interval: Duration::from_micros(dt_us.unsigned_abs()),
        };
        session.log_views_at_once(Viewpoint::MAX);
        // The first frame is likely to be where the ego is: load that while the agent prepares.
        let here = session.state.episode.world_from_rig();
        session.prefetch_at(vec![(Urgency::Imminent, here)]);
        session
    }

    /// Reserves memory for another version in place of that of its own.
    ///
    /// # Errors
    /// Its worst frame does not fit; nothing has changed then.
    pub(super) fn exchange_memory(
        &mut self,
        resident: Arc<Resident>,
        scenes: SceneBytes,
        frame: FrameBytes,
    ) -> Result<(), SessionError> {
        let before = self.reservation.views_at_once();
        self.reservation.exchange(resident, scenes, frame)?;
        self.log_views_at_once(before);
        Ok(())
    }

    /// Says that frames are drawn camera by camera, or no longer, if that has changed.
    fn log_views_at_once(&self, before: usize) {
        let now = self.reservation.views_at_once();
        if now == before || self.settings.layout.cameras().len() <= 1 {
            return;
        }
        let session = &self.name;
        if now == 1 {
            tracing::info!(
                session,
                "memory is short: frames are drawn camera by camera, which takes longer"
            );
        } else {
            tracing::info!(session, "frames are drawn with all cameras at once again");
        }
    }

    /// Number of the twin's latest version, if it is newer than the session's own. It is known
    /// about a second after it was made, in an object store ten seconds.
    pub fn newer_version(&self) -> Option<u64> {
        let own = &self.resident().version;
        let latest = self.engine.known_latest(&own.manifest.twin);
        latest.filter(|latest| *latest > own.number)
    }

    /// Switches to a newer version if there is one and the session follows them. A version that the
    /// session cannot show is left out: observations say that it is there.
    pub(super) async fn follow_latest(&mut self) {
        if !self.settings.follows_latest {
            return;
        }
        // A version that could not be followed is not tried again at each step.
        let newer = self.newer_version().filter(|newer| self.not_followed != Some(*newer));
        let Some(newer) = newer else { return };
        if let Err(error) = self.switch_version(Some(newer)).await {
            tracing::warn!(session = self.name, "version {newer} cannot be followed: {error}");
            self.not_followed = Some(newer);
        }
    }

    /// Switches to another version of the twin, or to its latest; the episode goes on.
    ///
    /// The switch is recorded together with the next frame, so that one which fails or is dropped
    /// leaves no trace.
    ///
    /// # Errors
    /// The version cannot be opened, or its worst frame does not fit. The session stays on its own
    /// version.
    pub async fn switch_version(&mut self, version: Option<u64>) -> Result<(), SessionError> {
        let current = &self.resident().version;
        let resident = self.engine.open_version(current.manifest.twin.clone(), version).await?;
        // A switch to the version itself would be an entry in the record without a change.
        if resident.version.number == current.number {
            return Ok(());
        }
        let extent = layout_extent(&self.settings.layout);
        let coverage_for = self.version.coverage.as_ref().map(|_| "outputs.trust");
        let profile = resolve_profile(&self.engine, &resident, &self.settings)?;
        let solid_ego = self.settings.solid_ego;
        let version =
            prepare(&self.engine, resident.clone(), profile, coverage_for, solid_ego).await?;
        let may_split = self.settings.may_split();
        let scenes =
            Engine::scene_bytes(resident.clone(), extent, version.profile, may_split).await?;
        let frame = frame_bytes(&self.engine, &self.settings.layout, &version);
        let references = load_references(&self.engine, &resident, &self.settings).await?;
        // There is no `await` from here on, so that a dropped future cannot leave half a switch.
        self.exchange_memory(resident, scenes, frame)?;
        self.version = version.with_references(references);
        self.version_switched = true;
        // Where the ego is comes first, because the next frame is there.
        let mut places = vec![(Urgency::Imminent, self.state.episode.world_from_rig())];
        places.extend(self.forecast().places());
        self.prefetch_at(places);
        Ok(())
    }
}

/// The options of a session, checked as far as that needs no twin.
struct Asked {
    twin: String,
    version: Option<u64>,
    seed: u64,
    start: Option<Start>,
    rig: Option<AskedRig>,
    profile: ProfileOverrides,
    outputs: Outputs,
    /// The motion model, if the request names one.
    dynamics: Option<Dynamics>,
    dt_us: i64,
    deadline: Duration,
    decision_us: Option<i64>,
    warm_up_us: Option<i64>,
    scenario: Option<(ScenarioSource, BTreeMap<String, Value>)>,
    repair: Option<Repair>,
    sensors: Option<Sensors>,
    contact: Option<ContactMode>,
    is_recorded: bool,
    follows_latest: bool,
}

enum AskedRig {
    /// A rig that comes with the program, by name.
    Preset(String),
    /// Its overlays are not decoded yet.
    Unread(UnreadRig),
}

/// A rig that is asked for, with its overlays.
enum ChosenRig {
    Preset(String),
    Full(Rig),
}

/// The rig with its overlays, which may take a second to decompress. Few are decompressed at once,
/// each within memory that was reserved for it.
async fn decoded(
    engine: &Engine,
    asked: Option<AskedRig>,
) -> Result<Option<ChosenRig>, SessionError> {
    let unread = match asked {
        None => return Ok(None),
        Some(AskedRig::Preset(name)) => return Ok(Some(ChosenRig::Preset(name))),
        Some(AskedRig::Unread(unread)) => unread,
    };
    let bytes = unread.decoding_bytes();
    // Before the turn, so that requests that wait hold no more than their messages and this budget.
    let reserved = engine.answer_budget().reserve(bytes)?;
    // A rig without overlays has nothing to decode, and need not wait.
    let turn = if bytes == 0 { None } else { Some(engine.overlay_turn().await?) };
    let decode = move || {
        let rig = unread.decode();
        // Held until the decoding ends, which a caller that no longer waits does not stop.
        drop((turn, reserved));
        rig
    };
    Ok(Some(ChosenRig::Full(run_blocking(decode).await??)))
}

impl Asked {
    fn new(options: Open, step_timeout: Duration) -> Result<Self, SessionError> {
        let rig = match options.rig {
            None => None,
            Some(RigChoice::Preset(name)) => Some(AskedRig::Preset(name)),
            Some(RigChoice::Full(rig)) => Some(AskedRig::Unread(UnreadRig::from_request(rig)?)),
        };
        let scenario = options.scenario.map(ScenarioSource::from_choice).transpose()?;
        // The store checks names again; this error names the field.
        if !is_name(&options.twin) {
            return Err(SessionError::Name { field: "twin", name: options.twin });
        }
        if let Some(Start::Pose { pose }) = &options.start {
            checked_pose(*pose)?;
        }
        let dynamics = options
            .dynamics
            .map(wildcity_options::Dynamics::from)
            .map(Dynamics::try_from)
            .transpose()?;
        // How long a step takes in simulated time, and an answer in real time.
        let dt_us = check_dt(options.dt_us)?;
        let deadline =
            check_deadline(options.deadline_ms.map(Duration::from_millis), step_timeout)?;
        check_contact(options.contact, scenario.is_some())?;
        if let (Some(Follow::Latest), Some(version)) = (options.follow, options.version) {
            let must = format!("\"latest\", with version {version}: leave one of the two away");
            return Err(SessionError::OutOfRange { field: "follow", must });
        }
        Ok(Self {
            twin: options.twin,
            version: options.version,
            seed: options.seed,
            start: options.start,
            rig,
            profile: ProfileOverrides::new(options.profile),
            outputs: options.outputs,
            dynamics,
            dt_us,
            deadline,
            decision_us: options.decision_us,
            warm_up_us: options.warm_up_us,
            scenario,
            repair: options.repair,
            sensors: options.sensors.and_then(used),
            contact: options.contact,
            is_recorded: options.record.unwrap_or(true),
            follows_latest: options.follow.is_some(),
        })
    }

    /// Loads the repair model, which takes seconds.
    async fn load_repair(
        &self,
        engine: &Engine,
        cameras: &[RigCamera],
    ) -> Result<Option<Arc<SessionRepair>>, SessionError> {
        let Some(asked) = self.repair.clone() else { return Ok(None) };
        let models = engine.repairs().clone();
        let cameras = cameras.to_vec();
        let deadline = self.deadline;
        let reports_trust = self.outputs.trust.unwrap_or(false);
        let open = move || SessionRepair::open(&models, &asked, &cameras, deadline, reports_trust);
        Ok(Some(Arc::new(run_blocking(open).await??)))
    }

    /// Which images an observation holds, and how they lie in its message. `actors` is how many
    /// are reported; `None` without a scenario.
    fn layout(
        &self,
        cameras: Vec<RigCamera>,
        lidars: Vec<RigLidar>,
        repair: Option<&SessionRepair>,
        actors: Option<usize>,
    ) -> Result<ObservationLayout, SessionError> {
        let outputs = &self.outputs;
        let periods_us = outputs.period_us.clone().unwrap_or_default();
        let schedule =
            Schedule::new(&cameras, self.dt_us, outputs.frames, &periods_us, self.decision_us)?;
        let encoding = ImageEncoding::new(outputs);
        let maps = PixelMaps::new(outputs);
        let mut layout =
            ObservationLayout::new(cameras, encoding, maps, schedule)?.with_lidars(lidars);
        if repair.is_some() {
            layout.reserve_repair();
        }
        if repair.is_some_and(SessionRepair::needs_images) {
            layout.reserve_references()?;
        }
        if let Some(sensors) = &self.sensors {
            layout.add_sensors(sensors.clone(), self.dt_us)?;
        }
        // Last, because its check covers what the others have added.
        if let Some(actors) = actors {
            layout.reserve_header(actors)?;
        }
        Ok(layout)
    }
}

/// Where the ego starts and how it moves: as the request says, then as the scenario says.
struct AskedEgo {
    start: Option<Start>,
    dynamics: Dynamics,
    warm_up_us: i64,
}

impl AskedEgo {
    fn new(asked: &Asked, scenario: Option<&OpenedScenario>) -> Self {
        let resolved = scenario.map(OpenedScenario::resolved);
        let start = asked.start.clone();
        let scenario_start =
            || scenario.and_then(|opened| opened.scenario.start(&opened.episode.loaded));
        let dynamics = asked.dynamics.or_else(|| resolved?.dynamics);
        let warm_up_us = asked.warm_up_us.or_else(|| resolved?.warm_up_us);
        Self {
            start: start.or_else(scenario_start),
            dynamics: dynamics.unwrap_or_default(),
            warm_up_us: warm_up_us.unwrap_or(0),
        }
    }
}

/// The scenario of a session, and its first episode.
struct OpenedScenario {
    scenario: SessionScenario,
    episode: EpisodeScenario,
}

impl OpenedScenario {
    async fn read(
        engine: &Arc<Engine>,
        resident: &Arc<Resident>,
        (source, values): (ScenarioSource, BTreeMap<String, Value>),
        asked: &Asked,
    ) -> Result<Self, SessionError> {
        let engine = engine.clone();
        let version = resident.version.clone();
        let seed = asked.seed;
        // A start that the request names is that of all its episodes, whatever the scenario says.
        let gives_start = asked.start.is_none();
        let turns = engine.clone();
        let read = move |stop: &Stop| {
            let scenarios = engine.scenarios().clone();
            let mut scenario = SessionScenario::read(scenarios, &source, &values, gives_start)?;
            stop.refusal()?;
            let episode = scenario.for_episode(seed, &version, &engine)?;
            check_line(&episode.loaded, &version.manifest)?;
            scenario.pin_assets(&episode.loaded);
            Ok(Self { scenario, episode })
        };
        turns.in_scenario_turn(read).await
    }

    fn resolved(&self) -> &Scenario {
        &self.episode.loaded.scenario
    }
}

/// Refuses a scenario whose line in a record could not be read back: before anything is driven, and
/// not afterwards.
fn check_line(loaded: &LoadedScenario, manifest: &Manifest) -> Result<(), SessionError> {
    let drives = &manifest.trajectories;
    let line = scenario_line(&loaded.scenario, loaded.map.as_ref(), &loaded.hash, drives);
    line.check().map_err(|reason| {
        let must = format!("too large: {reason}");
        SessionError::OutOfRange { field: "scenario.map", must }
    })
}

/// The profile of a version with the session's overrides.
///
/// # Errors
/// An override is out of range, or the backend cannot render the profile.
fn resolve_profile(
    engine: &Engine,
    resident: &Resident,
    settings: &SessionSettings,
) -> Result<RenderProfile, SessionError> {
    let profile = settings.profile_overrides.apply(resident.version.manifest.profile)?;
    engine.check_profile(&profile)?;
    Ok(profile)
}

/// Prepares a version for the episodes of a session: bakes its sky, finds what is where, and reads
/// where it was trained if the field `coverage_for` of the request needs to know. With the box
/// `solid_ego`, contact with the twin is looked for.
pub(super) async fn prepare(
    engine: &Arc<Engine>,
    resident: Arc<Resident>,
    profile: RenderProfile,
    coverage_for: Option<&'static str>,
    solid_ego: Option<EgoBox>,
) -> Result<PinnedVersion, SessionError> {
    Engine::bake_sky(resident.clone(), profile).await?;
    let index = {
        let engine = engine.clone();
        let resident = resident.clone();
        run_blocking(move || engine.spatial_index(&resident)).await?
    };
    let solids = solid_ego.map(|ego_box| engine.solids(index.clone(), ego_box));
    let coverage = match coverage_for {
        Some(field) => Some(training_coverage(&resident, field).await?),
        None => None,
    };
    Ok(PinnedVersion::new(resident, profile, coverage, index).with_solids(solids))
}

/// With a scenario, only the scenario says what a contact does.
fn check_contact(contact: Option<ContactMode>, has_scenario: bool) -> Result<(), SessionError> {
    match contact {
        Some(ContactMode::End | ContactMode::Report) if has_scenario => {
            let must =
                "given with a scenario, which decides: write end.contact there, or \"off\" here";
            Err(SessionError::OutOfRange { field: "contact", must: must.to_owned() })
        }
        _ => Ok(()),
    }
}

/// The box of the ego with which contact with the twin is looked for; `None` if it is not.
pub(super) fn solid_ego(
    contact: Option<ContactMode>,
    scenario: Option<&Scenario>,
) -> Option<EgoBox> {
    let is_off = contact == Some(ContactMode::Off)
        || scenario.is_some_and(|scenario| scenario.file.verdict.twin_contact == Some(false));
    // The size of the scenario's ego, with which its contacts with actors are looked for too.
    let ego_box = scenario.map_or_else(EgoBox::default, |scenario| scenario.traffic.ego_box);
    (!is_off).then_some(ego_box)
}

fn check_dt(dt_us: Option<i64>) -> Result<i64, SessionError> {
    let dt_us = dt_us.unwrap_or(limits::DT_US);
    let accepted_us: RangeInclusive<i64> = limits::DT_MIN_US..=limits::DT_MAX_US;
    if !accepted_us.contains(&dt_us) {
        let must = format!("{dt_us} µs; {accepted_us:?} µs are accepted");
        return Err(SessionError::OutOfRange { field: "dt_us", must });
    }
    Ok(dt_us)
}

fn check_deadline(
    deadline: Option<Duration>,
    step_timeout: Duration,
) -> Result<Duration, SessionError> {
    let deadline = deadline.unwrap_or(step_timeout);
    // A longer deadline would never be reached: the server ends a step after its own.
    if deadline.is_zero() || deadline > step_timeout {
        let must =
            format!("{deadline:?}; more than zero and at most {step_timeout:?} are accepted");
        return Err(SessionError::OutOfRange { field: "deadline_ms", must });
    }
    Ok(deadline)
}

/// The chosen rig, or the twin's, or the default preset, with the requested cameras in the
/// requested order.
fn select_cameras(
    manifest: &Manifest,
    choice: Option<ChosenRig>,
    outputs: &Outputs,
) -> Result<Rig, SessionError> {
    let preset = |name: &str| {
        Rig::preset(name).ok_or_else(|| SessionError::UnknownRig {
            name: name.to_owned(),
            known: Rig::preset_names().collect(),
        })
    };
    let rig = match choice {
        Some(ChosenRig::Full(rig)) => rig,
        Some(ChosenRig::Preset(name)) => preset(&name)?,
        None => match &manifest.rig {
            Some(rig) => rig.clone(),
            None => preset(limits::RIG)?,
        },
    };
    let Some(names) = &outputs.cameras else { return Ok(rig) };
    if names.is_empty() {
        let must = format!("without names; 1 to {} are accepted", rig.cameras.len());
        return Err(SessionError::OutOfRange { field: "outputs.cameras", must });
    }
    let mut selected: Vec<RigCamera> = Vec::with_capacity(names.len());
    for (index, name) in names.iter().enumerate() {
        let camera = rig.cameras.iter().find(|camera| camera.name == *name).ok_or_else(|| {
            let known = rig.cameras.iter().map(|camera| camera.name.clone()).collect();
            let field = format!("outputs.cameras[{index}]");
            SessionError::UnknownCamera { field, name: name.clone(), known }
        })?;
        // Names are unique in a rig, so that an equal camera is the same one.
        if selected.contains(camera) {
            return Err(SessionError::CameraTwice { index, name: name.clone() });
        }
        selected.push(camera.clone());
    }
    Ok(Rig { cameras: selected, ..rig })
}

/// The same rig with the requested crops and sizes.
fn crop_and_scale(mut rig: Rig, outputs: &Outputs) -> Result<Rig, SessionError> {
    let refused = |field: &str, must: String| {
        let field = format!("outputs.images{field}");
        SessionError::CameraOption { field, must }
    };
    // Check the overlays' sizes before any of them is scaled up.
    let rendered_pixels = |camera: &RigCamera| {
        let full = [camera.camera.width_px, camera.camera.height_px].map(u64::from);
        let part = outputs.images.get(&camera.name).copied().unwrap_or_default();
        let cropped = part.crop.map_or(full, |[_, _, width, height]| [width, height]);
        let [width, height] = part.size.unwrap_or(cropped);
        // The sizes are those of the request, and unchecked so far.
        width.saturating_mul(height)
    };
    let overlaid = rig.cameras.iter().filter(|camera| camera.appearance.overlay.is_some());
    let pixels = overlaid.map(rendered_pixels).fold(0, u64::saturating_add);
    check_overlay_pixels(pixels).map_err(|cause| refused("", format!("too large: {cause}")))?;

    for (name, ImagePart { crop, size }) in &outputs.images {
        let Some(index) = rig.cameras.iter().position(|camera| camera.name == *name) else {
            let known = rig.cameras.iter().map(|camera| camera.name.clone()).collect();
            let field = format!("outputs.images.{name}");
            return Err(SessionError::UnknownCamera { field, name: name.clone(), known });
        };
        let camera = &mut rig.cameras[index];
        // First the crop, in pixels of the rig's camera, and then the size of what is left.
        if let Some([left, top, width, height]) = *crop {
            let cropped = camera.cropped([left, top], [width, height]);
            *camera = cropped
                .map_err(|cause| refused(&format!(".{name}.crop"), format!("unusable: {cause}")))?;
        }
        if let Some([width, height]) = *size {
            let scaled = camera.scaled(width, height);
            *camera = scaled
                .map_err(|cause| refused(&format!(".{name}.size"), format!("unusable: {cause}")))?;
        }
    }
    Ok(rig)
}

/// The properties of a rig that determine how much memory its frames need.
pub(super) fn rig_extent(cameras: &[RigCamera], lidars: &[RigLidar]) -> RigExtent {
    RigExtent::new(&rig_viewpoints(cameras, lidars, Pose::IDENTITY), DVec3::ZERO)
}

/// That of a session's rig.
pub(super) fn layout_extent(layout: &ObservationLayout) -> RigExtent {
    rig_extent(layout.cameras(), layout.lidars())
}

/// What the frames of a session take beside their scenes.
pub(super) fn frame_bytes(
    engine: &Engine,
    layout: &ObservationLayout,
    version: &PinnedVersion,
) -> FrameBytes {
    // Buffers depend on sizes and not on places.
    let views = View::from_rig(layout.cameras(), Pose::IDENTITY);
    let rendered = layout.rendered_bytes(version.coverage.is_some());
    let frame = engine.frame_bytes(&views, &version.profile, rendered, layout.answers_bytes());
    // Sweeps are rendered one after the other, and not beside the session's own images.
    let lidars = layout.lidars().iter().map(|mounted| engine.sweep_bytes(&mounted.lidar));
    let sweep = lidars.max().unwrap_or(0);
    FrameBytes { stages: frame.stages.max(sweep), beside: frame.beside.max(sweep), ..frame }
}

/// The drive that the start names, else the twin's first.
fn drive_to_follow<'a>(drives: &'a [Trajectory], start: Option<&Start>) -> Option<&'a Trajectory> {
    match start {
        Some(
            Start::Station { trajectory, .. }
            | Start::Random { random: RandomStart { trajectory: Some(trajectory), .. } },
        ) => drives.iter().find(|drive| drive.name == *trajectory),
        // A pose may be near any drive: the forecast tests whether it is near this one.
        Some(Start::Pose { .. } | Start::Random { .. }) | None => drives.first(),
    }
}

/// The images that a repair model compares with; `None` if it needs none. Reads their table.
async fn load_references(
    engine: &Arc<Engine>,
    resident: &Arc<Resident>,
    settings: &SessionSettings,
) -> Result<Option<Arc<ReferenceViews>>, SessionError> {
    let Some(repair) = settings.repair.clone().filter(|repair| repair.needs_images()) else {
        return Ok(None);
    };
    let engine = engine.clone();
    let resident = resident.clone();
    let layout = settings.layout.clone();
    let read = move || {
        let version = resident.version.clone();
        let table = engine.catalog().views(&version)?;
        let views = ReferenceViews::new(version, table, layout.cameras());
        repair.check_references(views.as_ref(), layout.cameras())?;
        Ok::<_, SessionError>(views.map(Arc::new))
    };
    run_blocking(read).await?
}

/// Where a version of the twin was recorded and trained. `field` of the request needs it.
async fn training_coverage(
    resident: &Arc<Resident>,
    field: &'static str,
) -> Result<Arc<TrainingCoverage>, SessionError> {
    let resident = resident.clone();
    // Blocking: a long drive has half a million keyframes and blocks.
    let coverage = run_blocking(move || TrainingCoverage::new(&resident.version.manifest)).await?;
    coverage.map(Arc::new).ok_or_else(|| {
        // One is an object and the other one a flag.
        let set = if field == "repair" { "set" } else { "true" };
        let must = format!("{set}, and the twin has no recorded drive to compare with");
        SessionError::OutOfRange { field, must }
    })
}
