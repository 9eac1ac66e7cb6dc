//! Maps and scenarios of other formats, schemas of our own, and damaged files.

#[path = "../support/root.rs"]
mod root;

mod damaged;
mod geojson;
mod opendrive;
mod openscenario;
mod schema;
