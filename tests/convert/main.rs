//! Maps and scenarios of other formats, schemas of our own, and damaged files.

#[path = "../support/generated.rs"]
mod generated;

#[path = "../support/data.rs"]
mod data;

mod corpus;
mod damaged;
mod geojson;
mod opendrive;
mod openscenario;
mod openscenario_motion;
mod schema;

use generated::root;

/// A file of the small inputs with expected values.
fn case(name: &str) -> Option<Vec<u8>> {
    data::real(&format!("cases/{name}")).map(|path| std::fs::read(path).unwrap())
}
