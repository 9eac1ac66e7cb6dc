//! The machine of a history of uploads, and the promises to its clients.

mod promises;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::time::timeout;
use wildcity_twin::store::clock::Clock as _;

use crate::auth::Tokens;
use crate::config::{Limits, SpoolLimits};
use crate::limits;
use crate::spool::{Spool, SpoolMedium};

use super::super::disk::{Fault, Plant, ROOT, SimClock, SimDisk};
use super::super::machine::{CLIENT_TIMEOUT, Machine, SimServer};
use super::super::network::{Cut, CutStream};
use super::{AGE_S, Name, OWNERS, Operation, SIZES, Step};

/// Room for about three uploads of a token.
const LIMITS: SpoolLimits = SpoolLimits {
    uploads: 6,
    upload_bytes: 1_000,
    bytes: 500,
    token_bytes: Some(250),
    age: Duration::from_secs(AGE_S as u64),
};

/// Uploads of one token, at most: its share of [`LIMITS`].
const OWN_UPLOADS: usize = 3;

/// Times this close to a time-out may be on either side of it, because a slow read takes a minute.
const SLACK_US: i64 = 70_000_000;

/// Known state of an upload.
#[derive(Clone, Copy, Debug)]
struct Known {
    /// Bytes that the server has acknowledged.
    held: u64,
    is_complete: bool,
    /// When its files were last written, and when it was last announced or written, by the time of
    /// day.
    written_us: i64,
    used_us: i64,
    /// When bytes last came, by the clock that never jumps.
    active_us: i64,
}

/// The machine, and the promises to its clients.
pub(super) struct World<'a> {
    machine: &'a Machine,
    clock: Arc<SimClock>,
    disk: SimDisk,
    server: SimServer,
    known: BTreeMap<Name, Known>,
    /// Whether the disk may have files that a full disk kept from being removed.
    has_leftovers: bool,
}

/// Allowed changes of uploads by an operation.
#[derive(Default)]
struct Allowed {
    /// Uploads that may be gone.
    gone: BTreeSet<Name>,
    /// Uploads that may be new or larger, with the largest number of bytes.
    grown: BTreeMap<Name, u64>,
}

/// An answer of the server.
struct Answer {
    status: u16,
    body: Value,
}

/// The broken promise, if any.
pub(super) type Promise = Result<(), String>;

/// How an operation ended.
type Outcome = Result<(), Failure>;

/// Why an operation was not carried out.
enum Failure {
    /// The server refused it, as it may after a fault.
    Refused(String),
    /// A promise is broken.
    Broken(String),
}

impl Failure {
    /// An answer that is not expected without a fault.
    fn new(what: &str, Answer { status, body }: &Answer) -> Self {
        let reason = format!("{what} is answered with {status}: {body}");
        let is_panic = reason.contains("a task crashed");
        if matches!(status, 500 | 507) && !is_panic {
            Self::Refused(reason)
        } else {
            Self::Broken(reason)
        }
    }
}

impl From<String> for Failure {
    fn from(reason: String) -> Self {
        Self::Broken(reason)
    }
}

impl From<Failure> for String {
    fn from(failure: Failure) -> Self {
        match failure {
            Failure::Refused(reason) | Failure::Broken(reason) => reason,
        }
    }
}

fn content(file: usize) -> Vec<u8> {
    (0..SIZES[file]).map(|index| (index * 7 + file as u64) as u8).collect()
}

fn digest(file: usize) -> blake3::Hash {
    blake3::hash(&content(file))
}

fn id(file: usize) -> String {
    format!("blake3-{}", digest(file).to_hex())
}

fn tokens() -> Tokens {
    let token = |name: &str| json!({"name": name, "role": "push", "token": secret(name)});
    let tokens = json!({ "tokens": OWNERS.map(token) });
    Tokens::parse(tokens.to_string().as_bytes()).expect("tokens")
}

fn secret(owner: &str) -> String {
    format!("{owner}-0123456789abcdef")
}

fn open(machine: &Machine, disk: &SimDisk, clock: &Arc<SimClock>) -> Result<SimServer, String> {
    let disk = Arc::new(disk.clone());
    let dir = Path::new(ROOT).join("uploads");
    let medium = SpoolMedium { dir, disk, clock: clock.clone() };
    let spool = Spool::open(medium, LIMITS, OWNERS.len(), BTreeMap::new());
    let spool = spool.map_err(|error| format!("the spool does not open: {error}"))?;
    let limits = Limits { spool: LIMITS, ..Limits::default() };
    Ok(machine.server(limits, Some(tokens()), Ok(Arc::new(spool))))
}

impl<'a> World<'a> {
    pub(super) fn new(machine: &'a Machine, plant: Option<Plant>) -> Result<Self, String> {
        let clock = Arc::new(SimClock::new());
        let disk = SimDisk::new(clock.clone(), plant);
        let server = open(machine, &disk, &clock)?;
        Ok(Self { machine, clock, disk, server, known: BTreeMap::new(), has_leftovers: false })
    }

    /// Carries out one step. If it stops the process, starts the next one.
    pub(super) async fn run(&mut self, step: &Step) -> Promise {
        self.disk.set_fault(step.fault);
        self.disk.set_bad_reads(step.bad_reads);
        let mut allowed = Allowed::default();
        let done = self.carry_out(step.operation, &mut allowed).await;
        let was_full = matches!(step.fault, Some((_, Fault::Full))) && !self.disk.has_fault();
        let has_bad_reads = self.disk.take_failed_reads() > 0;
        self.disk.set_bad_reads(None);
        match done {
            Err(Failure::Refused(_)) if was_full || has_bad_reads || self.disk.is_stopped() => {}
            done => done?,
        }
        if self.disk.is_stopped() {
            return self.restart(step, &allowed);
        }
        self.disk.set_fault(None);
        self.has_leftovers |= was_full;
        if was_full && let Some(name) = step.operation.name() {
            // A full disk keeps nothing of the upload that it refused.
            allowed.gone.insert(name);
        }
        self.compare(&allowed)
    }

    async fn carry_out(&mut self, operation: Operation, allowed: &mut Allowed) -> Outcome {
        match operation {
            Operation::Begin(name) => self.begin(name, allowed).await,
            Operation::Append { name, bytes, cut } => self.append(name, bytes, cut, allowed).await,
            Operation::AppendTwice { name, bytes } => self.append_twice(name, bytes, allowed).await,
            Operation::WrongOffset(name) => self.wrong_offset(name).await,
            Operation::Delete(name) => self.delete(name, allowed).await,
            Operation::Foreign(name) => self.foreign(name).await,
            Operation::Expire => Ok(self.expire(allowed)?),
            Operation::Jump { seconds } => {
                self.clock.jump(seconds * 1_000_000);
                Ok(())
            }
            Operation::Wait { seconds } => {
                self.clock.wait(seconds * 1_000_000);
                Ok(())
            }
            Operation::Stop(fault) => {
                self.disk.stop(fault);
                Ok(())
            }
        }
    }

    /// Sends a request as the owner of a name. `None` if it is cut.
    async fn request(
        &self,
        owner: usize,
        head: &str,
        body: &[u8],
        cut: Option<u64>,
    ) -> Result<Option<Answer>, String> {
        let (stream, served) = self.server.connect(64 << 10).await;
        let mut stream = CutStream::new(stream, cut.map_or(Cut::Never, Cut::Sent));
        let secret = secret(OWNERS[owner]);
        let length = body.len();
        let head = format!(
            "{head}\r\nhost: localhost\r\nauthorization: Bearer {secret}\r\nconnection: close\r\n\
             content-length: {length}\r\n\r\n"
        );
        let exchanged = async {
            stream.write_all(&[head.as_bytes(), body].concat()).await.ok()?;
            let mut answer = Vec::new();
            stream.read_to_end(&mut answer).await.ok()?;
            Some(answer)
        };
        let answer =
            timeout(CLIENT_TIMEOUT, exchanged).await.map_err(|_| format!("no answer: {head}"))?;
        drop(stream);
        let ended = timeout(CLIENT_TIMEOUT, served).await;
        let ended = ended.map_err(|_| format!("the connection does not end: {head}"))?;
        ended.map_err(|error| format!("the task of the connection failed: {error}: {head}"))?;
        let Some(answer) = answer else { return Ok(None) };
        let answer = String::from_utf8_lossy(&answer).into_owned();
        let status = answer.get(9..12).and_then(|status| status.parse().ok());
        let status = status.ok_or_else(|| format!("{answer:?} is no answer to {head}"))?;
        let body = answer.split_once("\r\n\r\n").map_or("", |(_, body)| body);
        Ok(Some(Answer { status, body: serde_json::from_str(body).unwrap_or_default() }))
    }

    /// Uploads that may be removed because another one needs space; `None` if there is enough.
    fn pressure(&self, name: Name) -> Option<BTreeSet<Name>> {
        let others = || self.known.keys().filter(|other| **other != name);
        let own = || others().filter(|other| other.owner == name.owner);
        let bytes_of = |names: &mut dyn Iterator<Item = &Name>| -> u64 {
            names.map(|other| SIZES[other.file]).sum()
        };
        let size = SIZES[name.file];
        let is_own_full = own().count() >= OWN_UPLOADS
            || bytes_of(&mut own()) + size > LIMITS.token_bytes.unwrap_or(LIMITS.bytes);
        let is_full =
            others().count() >= LIMITS.uploads || bytes_of(&mut others()) + size > LIMITS.bytes;
        if !is_own_full && !is_full {
            return None;
        }
        let now_us = self.clock.monotonic_us();
        let is_removable = |other: &&Name| {
            let known = self.known[*other];
            let is_empty = known.held == 0 && !known.is_complete;
            let wait = if is_empty { limits::RESERVED_FOR } else { limits::KEPT_FOR };
            let is_idle = now_us - known.active_us >= wait.as_micros() as i64 - SLACK_US;
            is_idle || (other.owner == name.owner && known.is_complete)
        };
        Some(others().filter(is_removable).copied().collect())
    }

    async fn begin(&mut self, name: Name, allowed: &mut Allowed) -> Outcome {
        let pressure = self.pressure(name);
        allowed.gone.extend(pressure.iter().flatten());
        allowed.grown.insert(name, 0);
        let size = SIZES[name.file];
        let digest = format!("blake3:{}", digest(name.file).to_hex());
        let body = json!({ "name": "scene.ply", "size": size, "digest": digest }).to_string();
        let answer = self.request(name.owner, "POST /v1/uploads HTTP/1.1", body.as_bytes(), None);
        let Some(answer) = answer.await? else { return Ok(()) };
        match answer.status {
            status @ (200 | 201) => {
                let now_us = self.clock.now_us();
                let active_us = self.clock.monotonic_us();
                let is_complete = status == 200;
                let new =
                    Known { held: 0, is_complete, written_us: now_us, used_us: now_us, active_us };
                self.known.entry(name).or_insert(new).used_us = now_us;
                Ok(self.expect_offset(name, &answer.body)?)
            }
            507 if pressure.is_some() => Ok(()),
            _ => Err(Failure::new("an announcement", &answer)),
        }
    }

    /// Compares the offset in an answer with the known state.
    fn expect_offset(&self, name: Name, body: &Value) -> Promise {
        let held = self.known.get(&name).map_or(0, |known| known.held);
        if body["offset"].as_u64() == Some(held) {
            return Ok(());
        }
        Err(format!("{name:?} has {held} bytes, and the answer is {body}"))
    }

    async fn append(
        &mut self,
        name: Name,
        bytes: u64,
        cut: Option<u64>,
        allowed: &mut Allowed,
    ) -> Outcome {
        let held = self.known.get(&name).map_or(0, |known| known.held);
        let end = (held + bytes).min(SIZES[name.file]);
        let body = &content(name.file)[held as usize..end as usize];
        let pressure = self.pressure(name);
        if self.known.contains_key(&name) {
            allowed.gone.extend(pressure.iter().flatten());
            allowed.grown.insert(name, end);
        }
        let head = format!("PATCH /v1/uploads/{} HTTP/1.1\r\nupload-offset: {held}", id(name.file));
        let answer = self.request(name.owner, &head, body, cut).await?;
        self.settle(name).await?;
        let Some(answer) = answer else { return Ok(()) };
        match answer.status {
            404 if !self.known.contains_key(&name) => Ok(()),
            200 => self.appended(name, end, &answer.body),
            507 if pressure.is_some() => Ok(()),
            _ => Err(Failure::new("a part", &answer)),
        }
    }

    /// Records that an upload has bytes up to `end`, according to an answer.
    fn appended(&mut self, name: Name, end: u64, body: &Value) -> Outcome {
        let now_us = self.clock.now_us();
        let active_us = self.clock.monotonic_us();
        let known = self.known.get_mut(&name);
        let known = known.ok_or_else(|| "an unknown upload is continued".to_owned())?;
        if end > known.held {
            *known = Known { held: end, written_us: now_us, active_us, ..*known };
        }
        known.used_us = now_us;
        known.is_complete = end == SIZES[name.file];
        if body["complete"] != json!(known.is_complete) {
            let reason = format!("{end} bytes of {name:?} are answered with {body}");
            return Err(Failure::Broken(reason));
        }
        Ok(self.expect_offset(name, body)?)
    }

    /// At most one of two parts for one offset is accepted. The other is refused for its offset, or
    /// because the later connection replaced it.
    async fn append_twice(
        &mut self,
        name: Name,
        bytes: [u64; 2],
        allowed: &mut Allowed,
    ) -> Outcome {
        let held = self.known.get(&name).map_or(0, |known| known.held);
        let ends = bytes.map(|bytes| (held + bytes).min(SIZES[name.file]));
        let pressure = self.pressure(name);
        if self.known.contains_key(&name) {
            allowed.gone.extend(pressure.iter().flatten());
            allowed.grown.insert(name, ends[0].max(ends[1]));
        }
        let head = format!("PATCH /v1/uploads/{} HTTP/1.1\r\nupload-offset: {held}", id(name.file));
        let content = content(name.file);
        let part = |end: u64| &content[held as usize..end as usize];
        let answers = tokio::join!(
            self.request(name.owner, &head, part(ends[0]), None),
            self.request(name.owner, &head, part(ends[1]), None),
        );
        self.settle(name).await?;
        let mut taken = None;
        for (answer, end) in [(answers.0?, ends[0]), (answers.1?, ends[1])] {
            let Some(answer) = answer else { continue };
            match answer.status {
                404 if !self.known.contains_key(&name) => {}
                200 if end == held => {}
                200 if taken.is_none() => taken = Some((end, answer.body)),
                200 => {
                    let reason = format!("{name:?} took two parts for offset {held}");
                    return Err(Failure::Broken(reason));
                }
                409 => {}
                507 if pressure.is_some() => {}
                _ => return Err(Failure::new("one of two parts", &answer)),
            }
        }
        match taken {
            Some((end, body)) => self.appended(name, end, &body),
            None => Ok(()),
        }
    }

    /// Waits until the server has ended with an upload that was cut off.
    async fn settle(&self, name: Name) -> Promise {
        let spool = self.server.state.spool().map_err(|fault| fault.to_string())?;
        if let Ok(upload) = spool.get(OWNERS[name.owner], &id(name.file)) {
            upload.write().await.map_err(|fault| fault.to_string())?;
        }
        Ok(())
    }

    async fn wrong_offset(&self, name: Name) -> Outcome {
        let Some(known) = self.known.get(&name) else { return Ok(()) };
        let wrong = known.held + 1;
        let head =
            format!("PATCH /v1/uploads/{} HTTP/1.1\r\nupload-offset: {wrong}", id(name.file));
        let Some(answer) = self.request(name.owner, &head, b"x", None).await? else {
            return Ok(());
        };
        match answer.status {
            409 => Ok(self.expect_offset(name, &answer.body)?),
            _ => Err(Failure::new("a part for another offset", &answer)),
        }
    }

    async fn delete(&mut self, name: Name, allowed: &mut Allowed) -> Outcome {
        allowed.gone.insert(name);
        let head = format!("DELETE /v1/uploads/{} HTTP/1.1", id(name.file));
        let Some(answer) = self.request(name.owner, &head, b"", None).await? else { return Ok(()) };
        let was_known = self.known.contains_key(&name);
        match answer.status {
            204 if was_known => {
                if !self.disk.is_stopped() {
                    self.known.remove(&name);
                }
                Ok(())
            }
            404 if !was_known => Ok(()),
            _ => Err(Failure::new("a removal", &answer)),
        }
    }

    async fn foreign(&self, name: Name) -> Outcome {
        let other = Name { owner: 1 - name.owner, ..name };
        if self.known.contains_key(&other) {
            return Ok(());
        }
        let id = id(name.file);
        for method in ["GET", "DELETE"] {
            let head = format!("{method} /v1/uploads/{id} HTTP/1.1");
            match self.request(other.owner, &head, b"", None).await? {
                Some(Answer { status: 404, .. }) | None => {}
                Some(answer) => {
                    return Err(Failure::new(&format!("{method} of another's upload"), &answer));
                }
            }
        }
        Ok(())
    }

    fn expire(&mut self, allowed: &mut Allowed) -> Promise {
        let spool = self.server.state.spool().map_err(|fault| fault.to_string())?;
        spool.remove_old();
        let now_us = self.clock.now_us();
        let age_us = AGE_S * 1_000_000;
        for (name, known) in &self.known {
            // The clock may have jumped back before the last use.
            let last_us = known.used_us.min(known.written_us);
            if now_us - last_us >= age_us - SLACK_US {
                allowed.gone.insert(*name);
            }
            let is_over = now_us - known.used_us >= age_us + SLACK_US;
            if is_over && spool.get(OWNERS[name.owner], &id(name.file)).is_ok() {
                return Err(format!("{name:?} is kept for ever"));
            }
        }
        Ok(())
    }
}
