//! Loading ahead of the ego.

pub(crate) mod forecast;
pub(crate) mod latest_task;
