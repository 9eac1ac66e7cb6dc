//! `wildcity-bench soak`.

mod agent;
mod memory;
mod others;

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use tokio::task::JoinSet;

use wildcity_client::Pose as WirePose;
use wildcity_scene::Trajectory;
use wildcity_server::Running;
use wildcity_session::limits::LONGEST_POLL;
use wildcity_twin::store::Catalog;

use self::agent::{Agent, Driven};
use self::memory::Memory;
use self::others::Pusher;
use super::benched_twin::BenchedTwin;
use super::memory::{live_bytes, mib, rss_bytes};
use wildcity::cli::exit::Exit;

/// Drive many sessions of small cameras against a server for minutes or hours, and check that
/// memory does not grow, images do not change and no request holds up the others.
///
/// The server runs in this process. The twin needs a recorded drive: each session drives the same
/// stretch of the first one again and again, and compares the hash of every image with that of its
/// first round. Prints the memory of the process every minute: what is in RAM, and the blocks of
/// the heap that are in use, with the parts of them that are sections of twins and answers, which
/// have limits of their own. The exit code is 1 if a request fails, a hash changes, a task holds a
/// thread that answers requests for more than 500 ms, or more than one task in a thousand for more
/// than 50 ms, or the rest of the blocks grows by more than --growth. Growth is the largest median
/// of a later sixth of the time, compared with that of the second sixth: in the first one caches
/// fill. With --memory-gib below what the twin needs, the server evicts and loads all the time.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Soak {
    #[command(flatten)]
    twin: BenchedTwin,

    /// Duration, in minutes.
    #[arg(long, value_name = "N", default_value_t = 60.0, value_parser = minutes)]
    minutes: f64,

    /// Number of sessions at a time.
    #[arg(long, value_name = "K", default_value_t = 16, value_parser = clap::value_parser!(u32).range(1..=256))]
    sessions: u32,

    /// Steps of a session before it is closed and opened again.
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    steps: u32,

    /// Push new versions to a copy of the twin and collect garbage, send damaged requests, and open
    /// sessions that do not read their images, all at the same time.
    #[arg(long)]
    mixed: bool,

    /// Largest growth of the blocks that is accepted, in per cent.
    #[arg(long, value_name = "PERCENT", default_value_t = 2.0)]
    growth: f64,
}

const EXAMPLES: &str = "\
Examples:
  wildcity-bench soak street
  wildcity-bench soak street --minutes 12 --sessions 4 --memory-gib 0.1
  wildcity-bench soak street --minutes 30 --mixed";

/// Polls that may take longer than [`LONGEST_POLL`]: three, and one in a thousand. A system that
/// stops the thread which holds a lock makes those late that wait for it.
const LATE_POLLS: u64 = 3;
const LATE_ONE_IN: u64 = 1000;

/// No poll may take longer than this, in no case.
const STOPPED: Duration = Duration::from_millis(500);

/// Time between two lines.
const LINE_EVERY: Duration = Duration::from_secs(60);

/// Sessions beyond those of the agents: clients that do not read leave theirs to be resumed.
const OTHER_SESSIONS: usize = 64;

/// The drive of all sessions.
struct Driving {
    /// The directory or URL of twins.
    twins: PathBuf,
    /// The version that all sessions have.
    version: u64,
    route: Trajectory,
    /// Time at which it ends.
    until: Instant,
}

/// Memory of the process, sample by sample.
#[derive(Default)]
struct Watched {
    /// Blocks of the heap in use that are neither sections nor answers.
    rest: Memory,
    /// All memory in RAM.
    resident: Memory,
}

/// Counts of the other load in a mixed soak.
struct Others {
    pushes: u64,
    damaged: u64,
    unread: u64,
}

impl Soak {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let name = &self.twin.twin.name;
        let version = self.twin.twins.catalog()?.version(name, self.twin.twin.number)?;
        let Some(route) = version.manifest.trajectories.first().cloned() else {
            anyhow::bail!("twin {name:?} has no recorded drive to follow");
        };
        // Records, scenarios, uploads and the copied twin of this run only.
        let scratch = tempfile::tempdir()?;
        let mut twins = self.twin.twins.dir()?;
        if self.mixed {
            let copies = scratch.path().join("twins");
            others::copy_twin(&twins, &copies, name)?;
            twins = copies;
        }
        let mut config = self.twin.server(twins.clone(), scratch.path())?;
        config.mcap = false;
        config.limits.sessions =
            config.limits.sessions.max(self.sessions as usize + OTHER_SESSIONS);
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        let result = runtime.block_on(async {
            let running = wildcity_server::start(config).await?;
            let until = Instant::now() + self.length();
            let driving = Driving { twins, version: version.number, route, until };
            let result = self.soak(&running, &driving, scratch.path()).await;
            running.stop().await;
            result
        });
        runtime.shutdown_timeout(wildcity::cli::limits::SHUTDOWN_TIMEOUT);
        result
    }

    fn length(&self) -> Duration {
        Duration::from_secs_f64(60.0 * self.minutes)
    }

    async fn soak(
        &self,
        running: &Running,
        driving: &Driving,
        scratch: &Path,
    ) -> anyhow::Result<()> {
        let mut sessions = JoinSet::new();
        for number in 0..self.sessions {
            let agent = Agent {
                url: running.url(),
                twin: self.twin.twin.name.clone(),
                version: driving.version,
                route: driving.route.clone(),
                number,
                steps: self.steps,
                until: driving.until,
            };
            sessions.spawn(agent.drive());
        }
        let driven = async {
            let mut total = Driven::default();
            while let Some(driven) = sessions.join_next().await {
                let driven = driven.context("a session crashed")??;
                total.steps += driven.steps;
                total.rounds += driven.rounds;
            }
            anyhow::Ok(total)
        };
        let others = async {
            if self.mixed {
                self.others(running, driving, scratch).await.map(Some)
            } else {
                Ok(None)
            }
        };
        let watched = self.watch(running, driving.until);
        let (driven, others, memory) = tokio::try_join!(driven, others, watched)?;
        // Both are printed, also if the first one fails.
        let judged = self.judge(&driven, others.as_ref(), &memory);
        let polls = judge_polls(running);
        judged.and(polls)
    }

    /// Disturbs the server until the end.
    async fn others(
        &self,
        running: &Running,
        driving: &Driving,
        scratch: &Path,
    ) -> anyhow::Result<Others> {
        let twin = &self.twin.twin.name;
        // Otherwise garbage collection could remove the version while all agents change rounds.
        let catalog = Catalog::open(&driving.twins)?;
        let _lease = catalog.lease(twin, driving.version, "wildcity-bench soak", self.length())?;
        let start = driving.route.at_station(0.0);
        let pusher = Pusher {
            url: format!("http://{}", running.address()),
            catalog,
            twin: twin.clone(),
            at_m: start.position_m,
            scratch: scratch.to_owned(),
            until: driving.until,
        };
        let pose = WirePose { xyz: start.position_m.to_array(), q: start.q_wxyz() };
        let unread =
            others::leave_unread(running.url(), twin.clone(), driving.version, pose, driving.until);
        let damaged = others::send_damaged(running.address(), driving.until);
        let (pushes, damaged, unread) = tokio::try_join!(pusher.run(), damaged, unread)?;
        Ok(Others { pushes, damaged, unread })
    }

    /// Measures the memory until the end, and prints it every minute.
    async fn watch(&self, running: &Running, until: Instant) -> anyhow::Result<Watched> {
        let begun = Instant::now();
        let mut out = io::stdout();
        let mut memory = Watched::default();
        let mut next_line = begun;
        let mut tick = tokio::time::interval(Duration::from_secs(1));
        while Instant::now() < until {
            tick.tick().await;
            let resident = rss_bytes()?.now;
            let elapsed = begun.elapsed();
            let share = elapsed.div_duration_f64(self.length());
            let engine = running.engine();
            // Pages that sections have returned wait for the next ones.
            let sections = engine.residency().held_bytes + engine.catalog().free_page_bytes();
            let answers = engine.answer_bytes();
            let live = live_bytes()?;
            // Both have limits of their own. They are counted as they are allocated, and so is the
            // sum: what is in RAM may have nothing of an answer that is not written yet.
            memory.rest.add(share, live.saturating_sub(sections + answers));
            memory.resident.add(share, resident);
            if Instant::now() >= next_line {
                next_line += LINE_EVERY;
                let minutes = elapsed.as_secs_f64() / 60.0;
                writeln!(
                    out,
                    "{minutes:>6.1} min  {:>8.1} MiB in RAM; {:>8.1} MiB in use, of it {:>8.1} MiB of sections, \
                     {:>7.1} MiB of answers",
                    mib(resident),
                    mib(live),
                    mib(sections),
                    mib(answers),
                )?;
            }
        }
        Ok(memory)
    }

    /// Prints the counts.
    ///
    /// # Errors
    /// The memory grew by more than is accepted.
    fn judge(
        &self,
        driven: &Driven,
        others: Option<&Others>,
        memory: &Watched,
    ) -> anyhow::Result<()> {
        let mut out = io::stdout();
        if let Some(Others { pushes, damaged, unread }) = others {
            writeln!(
                out,
                "{pushes} pushes, each with garbage collection; {damaged} damaged requests; {unread} clients that did \
                 not read"
            )?;
        }
        let growths = memory.rest.growth().zip(memory.resident.growth());
        let (memory, resident) =
            growths.context("the soak was too short to compare memory: give more --minutes")?;
        let growth = memory.percent();
        writeln!(
            out,
            "{} steps in {} rounds of {} sessions, every image as in its first round; blocks in use without sections and answers \
             {:.1} MiB in the second sixth of the time, at most {:.1} MiB in a later one ({growth:+.2} %), medians; {:.1} MiB \
             at most",
            driven.steps,
            driven.rounds,
            self.sessions,
            mib(memory.early),
            mib(memory.later),
            mib(memory.most),
        )?;
        writeln!(
            out,
            "all memory in RAM {:.1} MiB in the second sixth, at most {:.1} MiB in a later one ({:+.2} %), medians; {:.1} MiB at most",
            mib(resident.early),
            mib(resident.later),
            resident.percent(),
            mib(resident.most),
        )?;
        // Without any memory at first it is no number.
        if growth.is_nan() || growth > self.growth {
            let message =
                format!("memory grew by {growth:.2} %, and {} % is accepted", self.growth);
            return Err(Exit::finding(1, message).into());
        }
        Ok(())
    }
}

/// Prints for how long tasks held the threads that answer requests.
///
/// # Errors
/// Too many held their thread for too long.
fn judge_polls(running: &Running) -> anyhow::Result<()> {
    let times = running.engine().polls().times();
    let polls: u64 = times.counts.iter().map(|(_, count)| count).sum();
    let longest_ms = times.longest.as_secs_f64() * 1e3;
    writeln!(
        io::stdout(),
        "{polls} polls of the server's tasks, the longest of {longest_ms:.1} ms"
    )?;
    let is_late = |(bound_s, _): &&(f64, u64)| *bound_s > LONGEST_POLL.as_secs_f64();
    let late: u64 = times.counts.iter().filter(is_late).map(|(_, count)| count).sum();
    if late > LATE_POLLS + polls / LATE_ONE_IN || times.longest > STOPPED {
        let most_ms = LONGEST_POLL.as_millis();
        let message = format!(
            "tasks held a thread that answers requests for more than {most_ms} ms {late} times, and for \
             {longest_ms:.1} ms at most"
        );
        return Err(Exit::finding(1, message).into());
    }
    Ok(())
}

fn minutes(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(minutes) if minutes > 0.0 && minutes <= 100_000.0 => Ok(minutes),
        _ => Err("expected minutes above 0, at most 100000".to_owned()),
    }
}
