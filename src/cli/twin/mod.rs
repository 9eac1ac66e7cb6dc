//! `wildcity twin`.

mod diff;
mod fsck;
mod gc;
mod generate;
mod list;
mod log;
mod rollback;
mod sky;

/// Keep twins: their versions, and what they take.
#[derive(Debug, clap::Args)]
pub(super) struct Twin {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    List(list::List),
    Generate(generate::Generate),
    Log(log::Log),
    Diff(diff::Diff),
    Rollback(rollback::Rollback),
    Gc(gc::Gc),
    Fsck(fsck::Fsck),
    Sky(sky::Sky),
}

impl Twin {
    pub(super) fn run(self) -> anyhow::Result<()> {
        match self.what {
            What::List(list) => list.run(),
            What::Generate(generate) => generate.run(),
            What::Log(log) => log.run(),
            What::Diff(diff) => diff.run(),
            What::Rollback(rollback) => rollback.run(),
            What::Gc(gc) => gc.run(),
            What::Fsck(fsck) => fsck.run(),
            What::Sky(sky) => sky.run(),
        }
    }
}
