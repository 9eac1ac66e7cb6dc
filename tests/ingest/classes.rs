//! Classes of Gaussians in the formats that have a column for them.

use wildcity_scene::{Gaussians, SemanticClass};
use wildcity_twin::ingest::write_ply;

use crate::format_files::{nurec_plain, usdz};
use crate::scene_files::{Tensor, gaussians, gsplat_tensors, safetensors};
use crate::{read, refusal};

const COUNT: usize = 60;

/// Gaussians with every class that they may have.
fn labelled() -> Gaussians {
    let mut scene = gaussians(COUNT, 1, 10.0, 5);
    let class = |i: usize| SemanticClass::ALL[1 + i % (SemanticClass::ALL.len() - 1)];
    scene.classes = Some((0..COUNT).map(class).collect());
    scene
}

fn ply(scene: &Gaussians) -> Vec<u8> {
    let mut file = Vec::new();
    write_ply(scene, &mut file).unwrap();
    file
}

/// A checkpoint with the tensor of classes of these values at its end.
fn checkpoint(scene: &Gaussians, values: &[u8], dtype: &str) -> Vec<u8> {
    let tensors: Vec<Tensor> = gsplat_tensors(scene);
    let plain = safetensors(&tensors, &[]);
    let length = u64::from_le_bytes(plain[..8].try_into().unwrap()) as usize;
    let (header, body) = plain[8..].split_at(length);
    let header = std::str::from_utf8(header).unwrap();
    let (start, end) = (body.len(), body.len() + values.len());
    let count = scene.len();
    let own = format!(
        r#","semantic_class":{{"dtype":"{dtype}","shape":[{count}],"data_offsets":[{start},{end}]}}}}"#
    );
    let header = format!("{}{own}", header.strip_suffix('}').unwrap());
    [&(header.len() as u64).to_le_bytes(), header.as_bytes(), body, values].concat()
}

#[test]
fn a_ply_file_keeps_classes() {
    let scene = labelled();
    let again = read(&ply(&scene)).unwrap();
    assert_eq!(again.classes, scene.classes);
    // Without classes, the file is the same as before there were any.
    let plain = Gaussians { classes: None, ..scene.clone() };
    let file = ply(&plain);
    assert!(!file.windows(5).any(|part| part == b"class"));
    assert_eq!(ply(&scene).len(), file.len() + "property uchar semantic_class\n".len() + COUNT);
    assert_eq!(read(&file).unwrap().classes, None);
}

#[test]
fn a_checkpoint_keeps_classes() {
    let scene = labelled();
    let values: Vec<u8> = scene.classes.iter().flatten().map(|class| class.value()).collect();
    assert_eq!(read(&checkpoint(&scene, &values, "U8")).unwrap().classes, scene.classes);
    assert_eq!(read(&safetensors(&gsplat_tensors(&scene), &[])).unwrap().classes, None);
}

#[test]
fn values_of_another_table_are_refused_with_their_place() {
    let scene = labelled();
    let mut file = ply(&scene);
    // The last byte of the last row.
    *file.last_mut().unwrap() = 77;
    let said = refusal(&file);
    let expected =
        "semantic_class is 77; the classes of Gaussians are 1 to 24, and 1 is unlabelled";
    assert_eq!(said, format!("PLY body, row 59 of vertex: {expected}"));

    let mut values: Vec<u8> = scene.classes.iter().flatten().map(|class| class.value()).collect();
    values[3] = 0;
    let said = refusal(&checkpoint(&scene, &values, "U8"));
    let place = "safetensors body, row 3 of tensor semantic_class: semantic_class is 0;";
    assert!(said.starts_with(place), "{said}");
    let said = refusal(&checkpoint(&scene, &values, "I8"));
    assert_eq!(said, "safetensors header, tensor semantic_class: is I8; U8 is read");
}

/// The layers of NuRec's own scenes are `background` and `road`.
#[test]
fn a_layer_of_nurec_has_the_class_of_its_name() {
    let scene = gaussians(6, 1, 5.0, 3);
    let renamed = |name: &[u8; 6]| {
        let mut plain = nurec_plain(&scene, false);
        for at in 0..plain.len() - 6 {
            if &plain[at..at + 6] == b"street" {
                plain[at..at + 6].copy_from_slice(name);
            }
        }
        read(&usdz(plain)).unwrap().classes
    };
    assert_eq!(renamed(b"street"), None);
    // Six letters, as `street`: a name of another length would change more of the file.
    assert_eq!(renamed(b"ground"), Some(vec![SemanticClass::Ground; 6]));
}
