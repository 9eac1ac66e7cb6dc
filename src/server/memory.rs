//! Observations in memory that a client on the same machine maps, in place of the socket.
//!
//! The memory is an anonymous file (memfd). It has no name in a file system, so that nothing is
//! left of it when the server or the client is killed at any moment: the kernel frees it with its
//! last descriptor and its last mapping. It does not depend on the size of `/dev/shm` either, which
//! is 64 MB in a container by default, less than three observations of six raw images.
//!
//! The client opens it by its path in `/proc` of this process. The kernel permits this only to
//! programs of the same user (and to root) in which this process has the same id. For another
//! program, the path may be of a different file: the target of the path, a symbolic link, has a
//! random name by which the client recognises the file before it opens it. Then it sends back a
//! random text from the file, which proves to the server that it can read the observations.
//!
//! The file has three slots, each as large as the largest answer, and its size is sealed: a client
//! that maps it is never killed by SIGBUS. Pages that were not written take no memory. Written
//! pages count against the budget for answers. A message that exceeds the budget is sent through
//! the socket, and the next message tries the memory again. The server writes with positioned
//! writes and maps nothing: there is one copy, from the observation that is kept for a repeated
//! request.

use std::fs::File;
use std::io;
use std::sync::Arc;

use wildcity_protocol::limits::{MEMORY_SLOTS, OBSERVATION_BYTES};
use wildcity_session::{BudgetShare, Engine};

use crate::fault::Fault;
use crate::limits;
use crate::sessions::Answer;

/// Unit in which the kernel gives memory to a file.
const PAGE_BYTES: u64 = 4096;

/// Memory that a connection shares with its client.
pub(crate) struct SharedMemory {
    file: Arc<File>,
    /// Path and target of the link by which the client opens it.
    pub(crate) path: String,
    pub(crate) target: String,
    proof: String,
    /// Whether the client has proven that it has opened the file.
    is_open: bool,
    /// The slot of the next message.
    next: usize,
    /// Bytes of each slot that take memory.
    held: [u64; MEMORY_SLOTS],
    /// Their share of the budget for answers.
    share: Option<BudgetShare>,
}

/// Where a message is in the memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct MemoryPlace {
    pub(crate) slot: usize,
    pub(crate) offset: u64,
    pub(crate) bytes: u64,
}

impl SharedMemory {
    /// Bytes from one slot to the next.
    pub(crate) const SLOT_BYTES: u64 = OBSERVATION_BYTES as u64;

    /// Creates memory that contains only the proof.
    ///
    /// # Errors
    /// The operating system is not Linux, or refuses.
    pub(crate) fn new() -> Result<Self, Fault> {
        let name = format!("wildcity-{}", uuid::Uuid::new_v4().as_simple());
        // 122 random bits, which a program that cannot read the memory does not guess.
        let proof = uuid::Uuid::new_v4().as_simple().to_string();
        let file = system::sealed_file(&name, MEMORY_SLOTS as u64 * Self::SLOT_BYTES)
            .and_then(|file| system::write_at(&file, 0, proof.as_bytes()).map(|()| file))
            .map_err(|error| Fault::NoSharedMemory {
                field: "type",
                reason: format!("{error}; connect without it"),
            })?;
        Ok(Self {
            path: system::open_file_path(&file),
            // What the kernel shows for a memfd: it has no name in any directory, so it looks
            // deleted.
            target: format!("/memfd:{name} (deleted)"),
            file: Arc::new(file),
            proof,
            is_open: false,
            next: 0,
            held: [0; MEMORY_SLOTS],
            share: None,
        })
    }

    /// Length of the proof.
    pub(crate) fn proof_bytes(&self) -> usize {
        self.proof.len()
    }

    /// Begins to use the memory, if the client sends the text that is in it.
    ///
    /// # Errors
    /// The client sends a different text.
    pub(crate) fn open(&mut self, proof: &str) -> Result<(), Fault> {
        // The proof is in the first slot, and is overwritten by the first message: it is of use
        // once.
        if proof != self.proof {
            let reason = "this is not the text at the beginning of the memory; connect without shared memory";
            return Err(Fault::NoSharedMemory { field: "proof", reason: reason.to_owned() });
        }
        self.is_open = true;
        Ok(())
    }

    /// Whether messages can be written.
    pub(crate) fn is_open(&self) -> bool {
        self.is_open
    }

    /// Writes a message into the next slot. The slot is used up only if the whole message has been
    /// written.
    ///
    /// # Errors
    /// The message is longer than a slot, or there is no memory.
    pub(crate) async fn write(
        &mut self,
        engine: &Engine,
        answer: &Answer,
    ) -> io::Result<MemoryPlace> {
        let bytes = answer.message_bytes();
        let slot = self.next;
        let offset = slot as u64 * Self::SLOT_BYTES;
        // The budget is asked before a byte is written, because pages that were written stay.
        self.hold(engine, slot, bytes)?;
        if bytes <= limits::INLINE_MEMORY_BYTES {
            write_parts(&self.file, offset, answer)?;
        } else {
            let file = self.file.clone();
            let answer = answer.clone();
            let written = tokio::task::spawn_blocking(move || write_parts(&file, offset, &answer));
            written.await.map_err(io::Error::other)??;
        }
        // The client reads the last answer while the next one is written, which is in another slot.
        self.next = (slot + 1) % MEMORY_SLOTS;
        Ok(MemoryPlace { slot, offset, bytes })
    }

    /// Counts the memory of a slot against the budget for answers, as far as it is not counted
    /// already.
    fn hold(&mut self, engine: &Engine, slot: usize, bytes: u64) -> io::Result<()> {
        if bytes > Self::SLOT_BYTES {
            return Err(io::ErrorKind::FileTooLarge.into());
        }
        // At most 4,095 B more than `bytes`. A page counts once: a slot keeps the pages of its
        // longest message.
        let needed = bytes.next_multiple_of(PAGE_BYTES);
        let more = needed.saturating_sub(self.held[slot]);
        if more == 0 {
            return Ok(());
        }
        let share = engine.reserve_answer_bytes(more).map_err(io::Error::other)?;
        match &mut self.share {
            // One share for the whole connection, which gives all of it back when it is dropped.
            Some(held) => held.merge(share),
            None => self.share = Some(share),
        }
        self.held[slot] = needed;
        Ok(())
    }
}

fn write_parts(file: &File, mut offset: u64, answer: &Answer) -> io::Result<()> {
    for part in answer.message_parts() {
        system::write_at(file, offset, part)?;
        offset += part.len() as u64;
    }
    Ok(())
}

#[cfg(target_os = "linux")]
mod system {
    use std::fs::File;
    use std::io;
    use std::os::fd::AsRawFd as _;
    use std::os::unix::fs::FileExt as _;

    use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, memfd_create};

    /// An anonymous file of zeros, whose size cannot be changed.
    pub(super) fn sealed_file(name: &str, bytes: u64) -> io::Result<File> {
        let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
        let file = File::from(memfd_create(name, flags)?);
        file.set_len(bytes)?;
        // SHRINK keeps the client's mapping valid, GROW keeps the memory bounded, and SEAL forbids
        // further seals, such as one against writing.
        fcntl_add_seals(&file, SealFlags::SHRINK | SealFlags::GROW | SealFlags::SEAL)?;
        Ok(file)
    }

    /// The path by which another program opens a file of this one.
    pub(super) fn open_file_path(file: &File) -> String {
        format!("/proc/{}/fd/{}", std::process::id(), file.as_raw_fd())
    }

    pub(super) fn write_at(file: &File, offset: u64, bytes: &[u8]) -> io::Result<()> {
        file.write_all_at(bytes, offset)
    }
}

#[cfg(not(target_os = "linux"))]
mod system {
    use std::fs::File;
    use std::io;

    fn unsupported() -> io::Error {
        io::Error::new(
            io::ErrorKind::Unsupported,
            "only Linux has the memory that is needed for it",
        )
    }

    pub(super) fn sealed_file(_: &str, _: u64) -> io::Result<File> {
        Err(unsupported())
    }

    pub(super) fn open_file_path(_: &File) -> String {
        String::new()
    }

    pub(super) fn write_at(_: &File, _: u64, _: &[u8]) -> io::Result<()> {
        Err(unsupported())
    }
}
