//! Suites: their files, runs with built-in agents and with commands, results, reports and
//! comparisons.

mod compare;
mod dial_in;
mod files;
mod overhead;
mod runs;
mod setups;
mod street;
mod traffic;
