//! Devices by name and number, and the errors where there is none.

use wildcity_render::automatic::self_test;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::gpu::{AdapterChoice, Gpu, GpuError, devices};

use crate::gpu::{gpu, gpu_on};

#[test]
fn a_device_is_selected_by_number_or_part_of_its_name() {
    let found = devices();
    assert!(!found.is_empty(), "no Vulkan driver: apt-get install mesa-vulkan-drivers");
    let name = found[0].name.clone();
    for choice in ["0".to_owned(), name.to_uppercase(), name[..4].to_owned()] {
        let gpu = gpu_on(&AdapterChoice::Named(choice.clone()), 1);
        assert_eq!(gpu.usage().unwrap().name, name, "{choice:?}");
    }
}

#[test]
fn an_unknown_device_is_named_in_the_error() {
    let choice = AdapterChoice::Named("no such card".to_owned());
    let error = Gpu::new(&choice, 1).unwrap_err();
    assert!(matches!(&error, GpuError::NoSuchAdapter { choice, .. } if choice == "no such card"));
    assert!(error.to_string().contains(&devices()[0].name), "{error}");
}

#[test]
fn software_is_not_taken_for_hardware() {
    let has_hardware = devices().iter().any(|device| device.kind != "cpu");
    match Gpu::new(&AdapterChoice::Hardware, 1) {
        Ok(_) => assert!(has_hardware),
        Err(error) => {
            assert_eq!((error, has_hardware), (GpuError::NoAdapter, false));
        }
    }
}

#[test]
fn another_device_of_an_adapter_outlives_the_first() {
    let first = gpu();
    let name = first.usage().unwrap().name;
    let another = first.another().unwrap();
    drop(first);
    assert_eq!(another.usage().unwrap().name, name);
    self_test(&another, &Cpu::new(0, Simd::Best).unwrap()).unwrap();
}

/// `--device` requires the gpu backend: another backend is never used silently.
#[test]
fn device_requires_the_gpu_backend() {
    let directory = tempfile::tempdir().unwrap();
    crate::demo::copy_demo_twin(&directory.path().join("t"));
    let run = |arguments: &[&str]| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_wildcity"));
        command.args(["demo", "--steps", "1", "--twins", "t", "--out", "o"]).args(arguments);
        let output = command.current_dir(directory.path()).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success(), "{arguments:?}: {said}");
        said
    };
    let said = run(&["--backend", "cpu", "--device", "0"]);
    assert!(said.contains("add --backend gpu"), "{said}");
    let said = run(&["--device", "no such card"]);
    assert!(said.contains("no device is called") && said.contains(&devices()[0].name), "{said}");
}

#[test]
fn a_shader_that_does_not_compile_is_an_error() {
    let broken = wildcity_render::gpu::shaders::Shaders::default();
    let broken = broken
        .with_mutation("ranges", "let own = touch_macro_tiles[i];", "let own = nothing[i];")
        .unwrap();
    let error = Gpu::with_shaders(&AdapterChoice::Best, 1, broken).unwrap_err();
    assert!(error.to_string().contains("nothing"), "{error}");
}

/// Separate processes with a loader that finds no driver.
#[test]
fn without_a_driver_it_is_an_ordinary_error() {
    let without = |program: &str, arguments: &[&str]| {
        let mut command = std::process::Command::new(program);
        command.args(arguments);
        for name in ["VK_DRIVER_FILES", "VK_ICD_FILENAMES"] {
            command.env(name, "/nonexistent");
        }
        let output = command.output().unwrap();
        (output.status.success(), String::from_utf8_lossy(&output.stdout).into_owned())
    };
    let (listed, said) = without(env!("CARGO_BIN_EXE_wildcity"), &["dev", "devices"]);
    assert!(listed && said.contains("mesa-vulkan-drivers"), "{said}");
    // Here `software_is_not_taken_for_hardware` sees no device at all.
    let this = std::env::current_exe().unwrap();
    let test = "devices::software_is_not_taken_for_hardware";
    let (passed, said) = without(&this.to_string_lossy(), &["--exact", test]);
    assert!(passed && said.contains("1 passed"), "{said}");
}

/// A warning of wgpu must make the test fail that caused it.
#[test]
fn a_warning_fails_its_test() {
    let output = std::process::Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "devices::warns", "--ignored"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(!output.status.success() && said.contains("WARN wgpu_hal: a trial"), "{said}");
}

#[test]
#[ignore = "fails on purpose, started by a_warning_fails_its_test"]
fn warns() {
    let _gpu = gpu();
    log::warn!(target: "wgpu_hal", "a trial");
}
