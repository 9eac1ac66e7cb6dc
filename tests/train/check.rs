//! The table that `wildcity train check` prints.

use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::gpu::{AdapterChoice, Gpu};
use wildcity_train::check::{Table, Vectors};

use crate::data::real;

#[test]
fn every_backend_keeps_every_bound() {
    let path = real("gradients/vectors.safetensors");
    let vectors = path
        .map(|path| Vectors::new(std::fs::read(path).expect("the vectors")).expect("safetensors"));
    let cpu = Cpu::new(0, Simd::Best).expect("a backend");
    // Without fused multiply-add, other pixels lie on the other side of the cut.
    let sse42 = Cpu::new(0, Simd::Sse42).expect("a backend");
    let gpu = Gpu::new(&AdapterChoice::Best, 0).expect("a Vulkan device: mesa-vulkan-drivers");
    let table =
        Table::new(&[&cpu, &sse42, &gpu], vectors.as_ref(), &mut |_, _| {}).expect("a table");
    eprintln!("{table}");
    assert_eq!(table.exceeded(), 0, "{table}");
    let of_vectors = table.rows.iter().filter(|row| row.against == "vectors").count();
    // The splats, and on all four backends three cases and two of the rig; the fisheye of the
    // backends is compared with the reference, which is compared with the vectors.
    assert!(of_vectors == 2 + 4 * 5 || vectors.is_none(), "{of_vectors} rows of vectors");
    assert!(table.rows.len() - of_vectors >= 3 * 24, "{} rows", table.rows.len());
}
