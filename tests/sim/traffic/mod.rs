//! Traffic: vectors of the formulas, and what must hold for every episode.

mod episodes;
mod formulas;
mod loads;
mod pairs;
