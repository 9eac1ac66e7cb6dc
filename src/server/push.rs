//! Pushes: accepted over HTTP, carried out one after the other, told about for a while.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use axum::body::Bytes;
use axum::extract::{Path, State as Shared};
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use axum::{Extension, Json};
use tokio::sync::Semaphore;

use crate::limits;
use wildcity_scene::RecordFormat;
use wildcity_scene::geometry::Pose;
use wildcity_twin::ingest::Axes;
use wildcity_twin::store::{Catalog, StoreError};

use super::auth::{Grant, Role};
use super::fault::Fault;
use super::refusal::Answered;
use super::report::{Report, State};
use super::spool::Upload;
use super::uploads::blocking;
use super::{Server, convert, publish};

/// What a push is asked to do, checked as far as it can be on its own.
#[derive(Clone, Debug)]
pub(super) struct Ask {
    /// Chosen by the client.
    pub(super) id: Option<String>,
    pub(super) twin: String,
    /// BLAKE3 of everything asked.
    pub(super) content: blake3::Hash,
    pub(super) files: Vec<AskedFile>,
    pub(super) base: Option<u64>,
    pub(super) cells: AskedCells,
    pub(super) record: Option<RecordFormat>,
    pub(super) levels: bool,
    /// Each as `near=0.2`.
    pub(super) profile: Vec<String>,
    pub(super) note: Option<String>,
    /// Where to compare; along the trajectory if none is said.
    pub(super) poses: Option<Vec<Pose>>,
    pub(super) min_psnr_db: Option<f64>,
}

/// One file of a push.
#[derive(Clone, Debug)]
pub(super) struct AskedFile {
    pub(super) upload: String,
    pub(super) axes: Axes,
    /// The same in words, for the record of where a version comes from.
    pub(super) options: [String; 2],
}

/// Which cells a push replaces.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum AskedCells {
    /// Those that its Gaussians lie in.
    Touched,
    /// These.
    These(BTreeSet<[i32; 2]>),
    /// All of the twin.
    All,
}

/// All pushes of a server that run, wait, or ended not long ago.
pub(super) struct Pushes {
    entries: Mutex<Entries>,
    /// One at a time: each takes the memory of its files, and all cores.
    pub(super) turn: Semaphore,
}

#[derive(Default)]
struct Entries {
    /// By twin and id.
    pushes: BTreeMap<(String, String), Arc<Push>>,
    begun: u64,
}

/// One push.
pub(super) struct Push {
    content: blake3::Hash,
    /// Counts pushes: the oldest is forgotten first.
    number: u64,
    status: Mutex<Status>,
}

/// How it stands with a push.
#[derive(Clone, Debug)]
pub(super) struct Status {
    pub(super) state: State,
    /// Done, of how much, within the state.
    pub(super) progress: (u64, u64),
    /// Number and hash of what was made.
    pub(super) version: Option<(u64, String)>,
    pub(super) report: Option<Arc<Report>>,
    pub(super) error: Option<Arc<Fault>>,
}

/// `POST /v1/twins/{twin}/pushes`: 202, and the work goes on. The same push again is answered with how
/// it stands.
pub(super) async fn begin(
    Shared(server): Shared<Arc<Server>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(twin): Path<String>,
    body: Bytes,
) -> Answered {
    grant.may(Role::Push)?;
    grant.reaches(&twin)?;
    let ask = convert::new_push(twin, &body)?;
    let (catalog, asked) = (server.engine.catalog().clone(), ask.clone());
    let latest = blocking(move || check_base(&catalog, &asked)).await?;
    // Made anew on top of another version, the same content is another push.
    let id = ask.id.clone().unwrap_or_else(|| {
        let of_content = [ask.content.as_bytes(), &latest.unwrap_or(0).to_le_bytes()[..]].concat();
        blake3::hash(&of_content).to_hex()[..32].to_owned()
    });
    let twin = ask.twin.clone();
    let uploads = find_uploads(&server, &ask);
    let (push, is_new) = server.pushes.begin(&ask, &id, uploads.is_ok())?;
    if is_new {
        // Found after the push: one that is known needs its uploads no more.
        tokio::spawn(publish::run(server.clone(), push.clone(), ask, uploads?));
    }
    Ok(answer(StatusCode::ACCEPTED, &id, &twin, &push))
}

/// `GET /v1/twins/{twin}/pushes/{id}`: how it stands.
pub(super) async fn look(
    Shared(server): Shared<Arc<Server>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path((twin, id)): Path<(String, String)>,
) -> Answered {
    grant.may(Role::Push)?;
    grant.reaches(&twin)?;
    let push = server.pushes.get(&twin, &id)?;
    Ok(answer(StatusCode::OK, &id, &twin, &push))
}

/// The twin's latest version, if there is one, and that the push can be made from the base it names.
fn check_base(catalog: &Catalog, ask: &Ask) -> Result<Option<u64>, Fault> {
    let versions = match catalog.versions(&ask.twin) {
        Ok(versions) => versions,
        Err(StoreError::NoTwin { .. }) if ask.base.is_none() => return Ok(None),
        Err(error) => return Err(error.into()),
    };
    let latest = versions.last().map(|entry| entry.number);
    if let (Some(base), Some(latest)) = (ask.base, latest) {
        let diff = catalog.diff(&ask.twin, base, latest)?;
        let differs: Vec<_> = diff.cells.iter().map(|differs| differs.cell).collect();
        let cells: Vec<_> = match &ask.cells {
            AskedCells::These(asked) => {
                differs.into_iter().filter(|cell| asked.contains(cell)).collect()
            }
            AskedCells::All => differs,
            // Known once its files are read; the store refuses it then.
            AskedCells::Touched => Vec::new(),
        };
        if !cells.is_empty() {
            let (name, settings) = (ask.twin.clone(), Vec::new());
            return Err(StoreError::Overlap { name, base, latest, cells, settings }.into());
        }
    }
    Ok(latest)
}

/// The finished uploads of a push. Held, they are not thrown away.
fn find_uploads(server: &Server, ask: &Ask) -> Result<Vec<Arc<Upload>>, Fault> {
    let spool = server.spool()?;
    let mut uploads = Vec::with_capacity(ask.files.len());
    for (index, file) in ask.files.iter().enumerate() {
        let upload = spool.get(&file.upload)?;
        if !upload.is_complete() {
            let (held, size) = (upload.offset(), upload.announced().size);
            let must = format!("an upload with {held} of {size} bytes: finish it first");
            return Err(Fault::OutOfRange { field: format!("files[{index}].upload"), must });
        }
        uploads.push(upload);
    }
    Ok(uploads)
}

impl Pushes {
    pub(super) fn new() -> Self {
        Self { entries: Mutex::default(), turn: Semaphore::new(1) }
    }

    /// Pushes that wait or run.
    pub(super) fn open(&self) -> usize {
        self.lock().pushes.values().filter(|push| push.is_open()).count()
    }

    /// The push of an id, and whether it is new: one that failed is begun anew. A new one needs what
    /// `may_begin` says is there.
    fn begin(&self, ask: &Ask, id: &str, may_begin: bool) -> Result<(Arc<Push>, bool), Fault> {
        let mut entries = self.lock();
        let key = (ask.twin.clone(), id.to_owned());
        if let Some(push) = entries.pushes.get(&key) {
            if push.content != ask.content {
                let must = format!("{id:?}, the id of a push that asked for something else");
                return Err(Fault::OutOfRange { field: "id".to_owned(), must });
            }
            if push.status().state != State::Failed {
                return Ok((push.clone(), false));
            }
        }
        if entries.pushes.values().filter(|push| push.is_open()).count() >= limits::PUSHES {
            return Err(Fault::Busy { what: "pushes", limit: limits::PUSHES });
        }
        entries.begun += 1;
        let status = Status {
            state: State::Queued,
            progress: (0, 0),
            version: None,
            report: None,
            error: None,
        };
        let (content, number) = (ask.content, entries.begun);
        let push = Arc::new(Push { content, number, status: Mutex::new(status) });
        if may_begin {
            entries.pushes.insert(key, push.clone());
            entries.forget();
        }
        Ok((push, true))
    }

    fn get(&self, twin: &str, id: &str) -> Result<Arc<Push>, Fault> {
        let found = self.lock().pushes.get(&(twin.to_owned(), id.to_owned())).cloned();
        found.ok_or_else(|| Fault::UnknownPush { id: id.to_owned(), twin: twin.to_owned() })
    }

    fn lock(&self) -> MutexGuard<'_, Entries> {
        // A panic elsewhere leaves nothing half-done behind this lock.
        self.entries.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Entries {
    /// The oldest that ended go, when there are too many.
    fn forget(&mut self) {
        while self.pushes.len() > limits::PUSHES_REMEMBERED {
            let ended = self.pushes.iter().filter(|(_, push)| !push.is_open());
            let Some(oldest) = ended.min_by_key(|(_, push)| push.number) else { return };
            let key = oldest.0.clone();
            self.pushes.remove(&key);
        }
    }
}

impl Push {
    pub(super) fn status(&self) -> Status {
        self.lock().clone()
    }

    /// Enters a state, at its beginning.
    pub(super) fn enter(&self, state: State) {
        let mut status = self.lock();
        (status.state, status.progress) = (state, (0, 0));
    }

    pub(super) fn progress(&self, done: u64, total: u64) {
        self.lock().progress = (done, total);
    }

    pub(super) fn tell(&self, report: Report) {
        self.lock().report = Some(Arc::new(report));
    }

    pub(super) fn end(&self, ended: Result<(u64, String), (State, Fault)>) {
        let mut status = self.lock();
        match ended {
            Ok(version) => (status.state, status.version) = (State::Ready, Some(version)),
            Err((state, fault)) => {
                (status.state, status.error) = (state, Some(Arc::new(fault)));
            }
        }
    }

    fn is_open(&self) -> bool {
        !matches!(self.lock().state, State::Ready | State::Refused | State::Failed)
    }

    fn lock(&self) -> MutexGuard<'_, Status> {
        self.status.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn answer(status: StatusCode, id: &str, twin: &str, push: &Push) -> Response {
    let body = Json(convert::push(id, twin, &push.status()));
    let mut response = (status, body).into_response();
    if let Ok(location) = HeaderValue::from_str(&format!("/v1/twins/{twin}/pushes/{id}")) {
        response.headers_mut().insert(header::LOCATION, location);
    }
    response
}
