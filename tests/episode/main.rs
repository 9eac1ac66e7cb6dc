//! Episodes' files: reading them whole and cut, comparing and scoring them.

mod diff;
mod export;
mod files;
mod scores;
mod written;
