//! Every mistake has its own error, which names the field and what to do; a model goes on after it.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use wildcity_repair::{
    Image, LoadOptions, Manifest, Model, NetworkManifest, Provider, RepairError, View,
};

use crate::onnx_doubles as doubles;
use crate::onnx_models::{Folder, library};
use crate::support::picture;

#[test]
fn a_nan_is_an_error_at_load_and_in_a_run_and_the_model_goes_on() {
    let error = Folder::new(&doubles::arithmetic("Mul", f32::NAN), json!({})).load().unwrap_err();
    assert!(matches!(error, RepairError::NotFinite { count: 12_288, of: 12_288, .. }), "{error}");
    // One that shows only with bright images. The probe has them: it is refused, too, so the range
    // is less.
    let dark = json!({"inputs": [{"name": "image", "role": "rgb", "range": [0, 0.48]}]});
    let mut folder = Folder::new(&doubles::nan_where_bright(), dark);
    let model = folder.load().unwrap();
    let image = picture(40, 30);
    model.repair(&View::new(&image)).unwrap();
    folder.manifest["inputs"][0]["range"] = json!([0, 1]);
    let error = folder.load().unwrap_err();
    assert!(matches!(error, RepairError::NotFinite { .. }), "{error}");
    assert!(error.to_string().contains("correct the range or dtype"), "{error}");
}

#[test]
fn shapes_names_types_and_ranks_are_compared_with_the_graph() {
    let error = Folder::new(&doubles::six_channels(), json!({})).load().unwrap_err();
    let text = error.to_string();
    assert!(
        text.contains("outputs[0].role") && text.contains("the graph [1, 6, -1, -1]"),
        "{text}"
    );

    let error = Folder::new(&doubles::without_a_row(), json!({})).load().unwrap_err();
    let RepairError::Shape { wanted, found, .. } = &error else { panic!("{error}") };
    assert_eq!((&wanted[..], &found[..]), (&[1, 3, 64, 64][..], &[1, 3, 63, 64][..]));

    for (changes, field, message) in [
        (
            json!({"inputs": [{"name": "rgb", "role": "rgb"}]}),
            "inputs[0].name",
            "the graph has \"image\"",
        ),
        (
            json!({"inputs": [{"name": "image", "role": "rgb", "dtype": "f16"}]}),
            "inputs[0].dtype",
            "float32",
        ),
        (json!({"layout": "nhwc"}), "inputs[0].role", "correct role, layout or size"),
        (
            json!({"outputs": [{"name": "out", "role": "rgb"}]}),
            "outputs[0].name",
            "the graph has \"repaired\"",
        ),
        (
            json!({"inputs": [{"name": "image", "role": "rgb"}, {"name": "depth", "role": "depth"}]}),
            "inputs[1].name",
            "the graph has \"image\"",
        ),
    ] {
        let error = Folder::new(&doubles::identity(), changes.clone()).load().unwrap_err();
        let RepairError::Manifest { field: at, message: said, .. } = &error else {
            panic!("{error}")
        };
        assert!(at == field && said.contains(message), "{changes}: {error}");
    }
}

#[test]
fn a_manifest_is_refused_with_the_field_that_is_wrong() {
    let cases: &[(Value, &str)] = &[
        (json!({"format": "wildcity.repair/2"}), "format"),
        (json!({"name": "a b"}), "name"),
        (json!({"colour": 1}), "colour"),
        (json!({"files": []}), "files"),
        (json!({"files": [{"path": "../m.onnx", "blake3": "0"}]}), "files[0].path"),
        (json!({"files": [{"path": "m.onnx", "blake3": "0"}]}), "files[0].blake3"),
        (json!({"providers": []}), "providers"),
        (json!({"providers": ["npu"]}), "providers[0]"),
        (json!({"timeout_ms": 0}), "timeout_ms"),
        (json!({"size": {"fit": "pad"}}), "size.fixed"),
        (json!({"size": {"fit": "pad", "multiple_of": 0}}), "size.multiple_of"),
        (json!({"size": {"fit": "resize", "multiple_of": 8}}), "size.pixels"),
        (json!({"size": {"fit": "tile", "multiple_of": 8, "tile": [60, 64]}}), "size.tile"),
        (json!({"inputs": [{"name": "d", "role": "depth"}]}), "inputs"),
        (json!({"inputs": [{"name": "image", "role": "rgb", "range": [1, 1]}]}), "inputs[0].range"),
        (json!({"inputs": [{"name": "image", "role": "rgb", "value": 1}]}), "inputs[0].value"),
        (json!({"outputs": [{"name": "repaired", "role": "luma"}]}), "outputs[0].role"),
        (json!({"outputs": [{"name": "repaired", "role": "rgb", "scale": 9}]}), "outputs[0].scale"),
        (json!({"outputs": [{"name": "repaired", "role": "residual"}]}), "merge"),
    ];
    for (changes, field) in cases {
        let error = Folder::new(&doubles::identity(), changes.clone()).load().unwrap_err();
        let RepairError::Manifest { field: at, .. } = &error else { panic!("{changes}: {error}") };
        assert_eq!(at, field, "{error}");
    }
}

#[test]
fn a_file_that_is_no_manifest_is_refused_as_that() {
    let file = Path::new("m.json");
    for (text, said) in [
        ("\x08\x07", "m.json: manifest: expected value at line 1 column 1; give the manifest"),
        ("{\"name\": \"a\"}", "m.json: format: missing; \"wildcity.repair/1\" is needed here"),
        ("{\"format\": \"wildcity.repair/1\"}", "m.json: manifest: missing field `name`"),
        // The fields of a network have other types; its format is what is wrong.
        (
            "{\"format\": \"wildcity.network/1\", \"size\": [1, 2]}",
            "m.json: format: \"wildcity.network/1\"; \"wildcity.repair/1\" is needed here",
        ),
    ] {
        let error = Manifest::parse(text.as_bytes(), file).unwrap_err().to_string();
        assert!(error.starts_with(said), "{error}");
    }
    let text = "{\"format\": \"wildcity.repair/1\", \"size\": {\"fixed\": [1, 2]}}";
    let error = NetworkManifest::parse(text.as_bytes(), file).unwrap_err().to_string();
    assert_eq!(
        error,
        "m.json: format: \"wildcity.repair/1\"; \"wildcity.network/1\" is needed here"
    );
}

/// A pipe would wait for a writer.
#[test]
fn a_pipe_in_place_of_a_model_is_refused() {
    let folder = Folder::new(&doubles::identity(), json!({}));
    let model = folder.folder.path().join("model.onnx");
    fs::remove_file(&model).unwrap();
    assert!(Command::new("mkfifo").arg(&model).status().unwrap().success());
    let error = folder.load().unwrap_err();
    let RepairError::File { path, message } = &error else { panic!("{error}") };
    assert_eq!((path, message.as_str()), (&model, "not a regular file"));
}

#[test]
fn a_model_that_was_swapped_on_disk_is_refused_and_one_in_use_is_not_affected() {
    let folder = Folder::new(&doubles::arithmetic("Add", 0.5), json!({}));
    let model = folder.load().unwrap();
    let image = picture(20, 10);
    let before = model.repair(&View::new(&image)).unwrap();
    let swapped = doubles::identity();
    fs::write(folder.folder.path().join("model.onnx"), &swapped).unwrap();
    assert_eq!(model.repair(&View::new(&image)).unwrap(), before);
    let error = folder.load().unwrap_err();
    let RepairError::Changed { field, found, .. } = &error else { panic!("{error}") };
    assert_eq!(field, "files[0]");
    assert_eq!(*found, blake3::hash(&swapped).to_hex().to_string());
    fs::remove_file(folder.folder.path().join("model.onnx")).unwrap();
    assert!(matches!(folder.load().unwrap_err(), RepairError::File { .. }));
}

#[test]
fn a_model_that_never_ends_is_stopped_at_its_time_limit() {
    let folder = Folder::new(&doubles::endless(), json!({"timeout_ms": 200}));
    let start = Instant::now();
    let error = folder.load().unwrap_err();
    assert_eq!(error, RepairError::TimedOut { limit_ms: 200 });
    assert!(start.elapsed() < Duration::from_secs(10), "{:?}", start.elapsed());
}

#[test]
fn a_stopped_run_leaves_the_model_as_it_was_until_there_were_ten() {
    let changes = json!({
        "timeout_ms": 300, "inputs": [{"name": "image", "role": "rgb", "range": [0, 0.9]}],
        "outputs": [{"name": "repaired", "role": "rgb", "range": [0, 0.9]}],
    });
    let model = Folder::new(&doubles::endless_if_bright(), changes).load().unwrap();
    let dark = picture(40, 30);
    let bright = Image { width: 1, height: 1, rgb8: vec![255; 3] };
    for _ in 1..10 {
        assert_eq!(model.repair(&View::new(&dark)).unwrap().image, dark);
        let error = model.repair(&View::new(&bright)).unwrap_err();
        assert_eq!(error, RepairError::TimedOut { limit_ms: 300 });
    }
    for image in [&bright, &dark] {
        let error = model.repair(&View::new(image)).unwrap_err();
        assert!(matches!(error, RepairError::Withdrawn { .. }), "{error}");
    }
}

#[test]
fn a_file_that_is_no_graph_is_refused() {
    let error = Folder::new(b"no graph", json!({})).load().unwrap_err();
    assert!(matches!(error, RepairError::Graph { .. }), "{error}");
    let mut cut = doubles::convolution(9, 1);
    cut.truncate(cut.len() / 2);
    assert!(matches!(Folder::new(&cut, json!({})).load().unwrap_err(), RepairError::Graph { .. }));
}

#[test]
fn a_provider_that_is_not_there_is_an_error_and_not_the_cpu() {
    let folder =
        Folder::new(&doubles::identity(), json!({"providers": ["cpu", "cuda", "tensorrt"]}));
    assert_eq!(folder.load().unwrap().provider(), Provider::Cpu);
    if fs::exists("/dev/nvidia0").unwrap() {
        eprintln!("this machine has a GPU: the missing provider is not tested");
        return;
    }
    for provider in [Provider::Cuda, Provider::Tensorrt] {
        let options = LoadOptions { provider: Some(provider), ..LoadOptions::new(library()) };
        let error = Model::load(&folder.path(), &options).unwrap_err();
        assert!(matches!(error, RepairError::Provider { .. }), "{error}");
    }
    let cpu_only = Folder::new(&doubles::identity(), json!({}));
    let options = LoadOptions { provider: Some(Provider::Cuda), ..LoadOptions::new(library()) };
    let error = Model::load(&cpu_only.path(), &options).unwrap_err();
    assert_eq!(error.to_string(), "provider: \"cuda\"; the manifest has cpu");
}

#[test]
fn without_a_library_the_error_says_how_to_name_one() {
    let folder = Folder::new(&doubles::identity(), json!({}));
    let error = Model::load(&folder.path(), &LoadOptions::new("")).unwrap_err();
    assert_eq!(error, RepairError::RuntimeUnnamed);
    let text = error.to_string();
    assert!(text.contains("--onnxruntime") && text.contains("ORT_DYLIB_PATH"), "{text}");
}

#[test]
fn images_of_wrong_sizes_are_refused_and_the_model_goes_on() {
    let model = Folder::new(&doubles::identity(), json!({})).load().unwrap();
    let image = picture(20, 10);
    let short = Image { width: 20, height: 10, rgb8: vec![0; 599] };
    let error = model.repair(&View::new(&short)).unwrap_err();
    assert_eq!(
        error.to_string(),
        "image: 20 x 10 px in 599 bytes; 20 x 10 px in 600 bytes are needed"
    );
    let empty = Image { width: 0, height: 10, rgb8: Vec::new() };
    assert!(model.repair(&View::new(&empty)).is_err());
    let depth = [f32::NAN; 200];
    let view = View { depth_m: Some(&depth), ..View::new(&image) };
    assert_eq!(
        model.repair(&view).unwrap_err().to_string(),
        "depth: value 0 is NaN; give finite values"
    );
    assert_eq!(model.repair(&View::new(&image)).unwrap().image, image);
}
