//! Compares the uploads of the server with the promises to its clients, now and after a restart.

use std::path::PathBuf;

use wildcity_twin::store::clock::Clock as _;

use super::super::super::disk::Fault;
use super::super::super::random::Random;
use super::super::super::reads::{BadReads, ReadFault};
use super::super::{Name, OWNERS, Operation, SIZES, Step};
use super::{Allowed, Failure, Known, Outcome, Promise, World, id, open};

impl World<'_> {
    /// Compares the uploads of the server with its promises, and updates the known state.
    pub(super) fn compare(&mut self, allowed: &Allowed) -> Promise {
        let spool = self.server.state.spool().map_err(|fault| fault.to_string())?;
        let now_us = self.clock.now_us();
        let active_us = self.clock.monotonic_us();
        let mut held_bytes = 0;
        for (owner, token) in OWNERS.into_iter().enumerate() {
            for file in 0..SIZES.len() {
                let name = Name { owner, file };
                let before = self.known.get(&name).copied();
                let Ok(upload) = spool.get(token, &id(file)) else {
                    if before.is_some() && !allowed.gone.contains(&name) {
                        return Err(format!("{name:?} is lost: {before:?}"));
                    }
                    self.known.remove(&name);
                    continue;
                };
                let held = upload.offset();
                held_bytes += held;
                let least = before.filter(|_| !allowed.gone.contains(&name)).map_or(0, |k| k.held);
                let most = before.map(|known| known.held).max(allowed.grown.get(&name).copied());
                if held < least || most.is_none_or(|most| held > most) {
                    return Err(format!("{name:?} has {held} bytes, not {least} to {most:?}"));
                }
                let was_complete = before.is_some_and(|known| known.is_complete);
                if was_complete && !upload.is_complete() && !allowed.gone.contains(&name) {
                    return Err(format!("{name:?} is no longer complete"));
                }
                let new = Known {
                    held,
                    is_complete: upload.is_complete(),
                    written_us: now_us,
                    used_us: now_us,
                    active_us,
                };
                let known = self.known.entry(name).or_insert(new);
                if known.held != held {
                    *known = new;
                }
                known.is_complete = upload.is_complete();
            }
        }
        let usage = spool.usage();
        if usage.uploads != self.known.len() {
            return Err(format!("{} uploads count as {}", self.known.len(), usage.uploads));
        }
        self.compare_files(held_bytes)
    }

    /// Compares the bytes that count with those on the disk.
    fn compare_files(&self, held_bytes: u64) -> Promise {
        let files = self.disk.files_below("");
        let kind =
            |path: &PathBuf| path.extension().and_then(|kind| kind.to_str()).map(str::to_owned);
        let mut stored_bytes = 0;
        let mut leftovers = Vec::new();
        for (path, bytes) in &files {
            match kind(path).as_deref() {
                Some("part" | "data") => stored_bytes += bytes,
                Some("gone") => leftovers.push(path),
                _ => {}
            }
        }
        if !self.has_leftovers && (stored_bytes != held_bytes || !leftovers.is_empty()) {
            return Err(format!(
                "{held_bytes} bytes count, and {stored_bytes} are on the disk: {files:?}"
            ));
        }
        Ok(())
    }

    /// Starts the next process, as after a kill or a power cut.
    pub(super) fn restart(&mut self, step: &Step, allowed: &Allowed) -> Promise {
        let fault = match (step.operation, step.fault) {
            (Operation::Stop(fault), _) => fault,
            (_, Some((_, fault))) => fault,
            (_, None) => Fault::Kill,
        };
        self.disk = self.disk.restarted(&mut Random::new(step.seed));
        if step.seed.is_multiple_of(4) {
            // A process that cannot read some of the uploads keeps them for the next one.
            let bad = [ReadFault::Error, ReadFault::Short][step.seed as usize / 4 % 2];
            let after = 3 + step.seed / 8 % 6;
            self.disk.set_bad_reads(Some(BadReads { after, fault: bad, times: 1 }));
            drop(open(self.machine, &self.disk, &self.clock)?);
            self.disk.stop(Fault::Kill);
            self.disk = self.disk.restarted(&mut Random::new(step.seed));
        }
        self.server = open(self.machine, &self.disk, &self.clock)?;
        self.has_leftovers = false;
        let active_us = self.clock.monotonic_us();
        let mut gone = allowed.gone.clone();
        let mut grown = allowed.grown.clone();
        if fault == Fault::PowerCut {
            // A removed upload may exist again.
            let names = (0..OWNERS.len() * SIZES.len())
                .map(|index| Name { owner: index % OWNERS.len(), file: index / OWNERS.len() });
            grown.extend(names.map(|name| (name, SIZES[name.file])));
        }
        for (name, known) in &mut self.known {
            known.active_us = active_us;
            known.used_us = known.used_us.max(known.written_us);
            // An incomplete upload may lose its last bytes in a power cut, or all.
            if fault == Fault::PowerCut && !known.is_complete {
                gone.insert(*name);
            }
        }
        self.compare(&Allowed { gone, grown })
    }

    /// Checks that the spool still works, and that no upload is left that uses its quota.
    pub(in super::super) async fn finish(mut self) -> Promise {
        let kill =
            Step { seed: 1, operation: Operation::Stop(Fault::Kill), fault: None, bad_reads: None };
        self.run(&kill).await?;
        for name in self.known.clone().into_keys() {
            if self.pressure(name).is_none() {
                self.finish_upload(name).await?;
            }
            self.delete(name, &mut Allowed::default()).await?;
        }
        self.compare(&Allowed::default())?;
        let spool = self.server.state.spool().map_err(|fault| fault.to_string())?;
        let left = self.disk.files_below("");
        if spool.usage() != Default::default() || left.len() != 1 {
            return Err(format!("{:?} count, and the disk has {left:?}", spool.usage()));
        }
        // As much as a token may have finds room.
        for file in [3, 1] {
            self.finish_upload(Name { owner: 0, file }).await?;
        }
        Ok(())
    }

    /// Begins an upload, or continues it, and sends the rest.
    async fn finish_upload(&mut self, name: Name) -> Outcome {
        let mut allowed = Allowed::default();
        self.begin(name, &mut allowed).await?;
        self.append(name, SIZES[name.file], None, &mut allowed).await?;
        if !self.known.get(&name).is_some_and(|known| known.is_complete) {
            let known = self.known.get(&name);
            return Err(Failure::Broken(format!("{name:?} cannot be finished: {known:?}")));
        }
        Ok(())
    }
}
