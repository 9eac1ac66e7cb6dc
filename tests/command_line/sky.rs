//! `wildcity import --sky` and `wildcity twin sky`.

use std::path::Path;

use wildcity_scene::RenderProfile;
use wildcity_twin::store::Catalog;

use crate::scene_files::{gaussians, safetensors};
use crate::sky_network::tensors;
use crate::wildcity;

#[test]
fn skies_are_imported_replaced_and_removed() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let run = |arguments: &[&str]| {
        let output =
            wildcity().args(arguments).args([Path::new("--twins"), &at("twins")]).output().unwrap();
        let said = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
        (output.status.code(), said(output.stdout), said(output.stderr))
    };
    let scene = gaussians(300, 0, 10.0, 1);
    let columns = crate::scene_files::inria_columns(0, false);
    std::fs::write(at("scene.ply"), crate::scene_files::ply(&scene, &columns)).unwrap();
    std::fs::write(at("sky.safetensors"), safetensors(&tensors(1), &[])).unwrap();
    let (ply, sky) = (at("scene.ply"), at("sky.safetensors"));
    let (ply, sky) = (ply.to_str().unwrap(), sky.to_str().unwrap());

    let axes = ["--axes", "y-down-z-forward"];
    let import = ["import", ply, "--twin", "street", "--sky", sky];
    let (code, _, error) = run(&[&import[..], &axes].concat());
    assert_eq!(code, Some(0), "{error}");
    let catalog = Catalog::open(&at("twins")).unwrap();
    let version = catalog.version("street", None).unwrap();
    // A sky network has the axes of its scene: z of the world (up) is -y of the file.
    let named = version.manifest.sky.clone().unwrap();
    assert_eq!(named.sky_from_world, [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]);
    let (_, said, _) = run(&["twin", "show", "street"]);
    assert!(said.contains(&format!("sky         {}", &named.object[..16])), "{said}");

    let (code, _, error) = run(&["twin", "sky", "street", "--remove"]);
    assert_eq!(code, Some(0), "{error}");
    let without = catalog.version("street", None).unwrap();
    assert_eq!((without.number, &without.manifest.sky), (2, &None));
    assert_eq!(without.manifest.chunks, version.manifest.chunks);
    let (code, said, _) = run(&["twin", "sky", "street", "--sky", sky, "--sky-axes", "identity"]);
    assert_eq!(code, Some(0));
    assert!(said.starts_with("twin street version 3: a sky of"), "{said}");
    let again = catalog.version("street", None).unwrap().manifest.sky.unwrap();
    assert_eq!(again.object, named.object);
    assert_eq!(again.sky_from_world, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);

    let coarse = ["twin", "sky", "street", "--sky", sky, "--set", "sky_error=0.05"];
    let (code, _, error) = run(&coarse);
    assert_eq!(code, Some(0), "{error}");
    let coarse = catalog.version("street", None).unwrap().manifest;
    let before = version.manifest.profile;
    assert_eq!(coarse.profile, RenderProfile { sky_error: 0.05, ..before });
    assert_eq!(coarse.chunks, version.manifest.chunks);

    let (code, _, error) = run(&["twin", "sky", "street"]);
    assert_eq!(code, Some(2), "neither a sky nor --remove: {error}");
    let (code, _, error) = run(&["twin", "sky", "street", "--sky", ply]);
    assert_eq!(code, Some(1));
    assert!(
        error.contains("scene.ply: sky header, start: it is not a safetensors file"),
        "{error}"
    );
}
