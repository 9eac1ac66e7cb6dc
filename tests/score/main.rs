//! Scores, against vectors computed from the published definitions (`shared/data/scores`), most of
//! which the anchors' own code confirmed.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/root.rs"]
mod root;
#[path = "../support/thread_time.rs"]
mod thread_time;
#[path = "../support/vectors.rs"]
mod vectors;

mod episodes;
mod hugsim;
mod navsim;
mod others;
mod plans;
mod statistics;
