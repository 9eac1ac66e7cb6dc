//! Suites of scenarios, run without a person: "did my driver get worse?" as one command.
//!
//! A suite names scenarios; a run drives each of them with each of its seeds, with an external
//! agent or with a built-in one, and judges every episode from its record. The results do not
//! depend on how many episodes are driven at once.
//!
//! | module | what it does |
//! |---|---|
//! | `file` | the format `wildcity.suite/1` |
//! | `case` | one scenario with one seed: the options of its session, and its properties in the results |
//! | `driver` | the built-in agents: `log`, `stand`, `idm` |
//! | `cameras` | the cameras of a suite, checked against a twin |
//! | `agent_process`, `stderr` | external agents: their processes, and the text that these print |
//! | `run` | drives all cases, some at once, technical failures once more |
//! | `finish` | judges the record of a driven episode |
//! | `verify` | renders all episodes again |
//! | `technical` | failures that are not driving |
//! | `result`, `entry` | `result.json`: episodes, rates, means |
//! | `compare` | two results: what got worse, what got better |
//! | `ending` | the exit code, and why |
//! | `junit`, `page`, `html` | `junit.xml`, `report.html` |
//! | `picture` | the picture of a fault |
//! | [`limits`] | limits |

mod agent_process;
mod cameras;
mod case;
mod compare;
mod driver;
mod ending;
mod entry;
mod error;
mod file;
mod finish;
mod html;
mod junit;
pub mod limits;
mod page;
mod picture;
mod plot;
mod process_group;
mod result;
mod run;
mod stderr;
mod technical;
mod verify;

pub use case::{Case, CaseOptions, cases};
pub use compare::{
    Change, ChangeCounts, CompareError, ComparedEpisode, Comparison, Direction, DrivenRun,
    PASS_RATE, PairedRate, Rule, RunName, ScoreChange, Side, Tolerance,
};
pub use driver::BuiltIn;
pub use ending::{Ending, ExitCode};
pub use entry::{EpisodeEntry, Status, TechnicalEntry};
pub use error::{AGENTS, SuiteError};
pub use file::{SuiteFile, SuiteScenario, check_criteria};
pub use junit::junit;
pub use page::page;
pub use picture::{ComparedPictures, Picture, pictures};
pub use result::{Counts, MeanEntry, Rate, SuiteResult};
pub use run::{AgentChoice, RunSettings, run};
pub use verify::verify;
