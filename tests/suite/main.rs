//! Suites: their files, runs with built-in agents and with commands, results and reports.

mod dial_in;
mod files;
mod overhead;
mod runs;
mod street;
mod traffic;
