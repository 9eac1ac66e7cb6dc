//! The table that `wildcity train check` prints.

use wildcity_render::cpu::{Cpu, Simd};
use wildcity_train::check::{Table, Vectors};

use crate::data::real;

#[test]
fn cpu_keeps_every_bound() {
    let path = real("gradients/vectors.safetensors");
    let vectors = path.map(|path| Vectors::new(std::fs::read(path).expect("the vectors")));
    let cpu = Cpu::new(0, Simd::Best).expect("a backend");
    let table = Table::new(&[&cpu], vectors.as_ref(), &mut |_, _| {}).expect("a table");
    eprintln!("{table}");
    assert_eq!(table.exceeded(), 0, "{table}");
    assert!(table.rows.len() >= 22 || vectors.is_none(), "{} rows", table.rows.len());
}
