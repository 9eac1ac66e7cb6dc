//! A version remembers how it was aligned with its capture, and changes that were made for other
//! axes are refused.

use std::f64::consts::FRAC_PI_2;

use glam::{DQuat, DVec3};
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_twin::store::{Catalog, Edit, NewVersion, StoreError, Version};

use crate::places::{cells_alone, change, commit};
use crate::scene_files::gaussians;

/// A quarter turn about `axis`, a move, and another unit.
fn turn(axis: DVec3, metres_per_unit: f64) -> Alignment {
    let rotation = DQuat::from_axis_angle(axis, FRAC_PI_2);
    let position_m = DVec3::new(1.0, -2.0, 0.5);
    Alignment { new_from_old: Pose { position_m, rotation }, metres_per_unit }
}

fn edit(catalog: &Catalog, base: &Version, alignment: Alignment) -> Result<Version, StoreError> {
    let edit = Edit { alignment, trajectories: Vec::new(), rig: None };
    catalog.edit(base, edit, &mut |_, _| {})
}

#[test]
fn alignments_are_remembered_as_one_until_a_rollback() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let first = commit(&catalog, &gaussians(300, 0, 10.0, 1));
    assert_eq!(first.manifest.twin_from_capture, None);
    let [one, two] = [turn(DVec3::X, 2.0), turn(DVec3::Z, 0.25)];
    let second = edit(&catalog, &first, one).unwrap();
    assert_eq!(second.manifest.twin_from_capture, Some(one));
    let third = edit(&catalog, &second, two).unwrap();
    let both = third.manifest.twin_from_capture.unwrap();
    let p = DVec3::new(3.0, 4.0, -5.0);
    assert!(both.point_m(p).distance(two.point_m(one.point_m(p))) < 1e-12, "{both}");
    // A change of cells and an edit without an alignment keep it.
    let fourth = change(&catalog, [0, 0], 2).change(3, cells_alone()).unwrap();
    assert_eq!(fourth.manifest.twin_from_capture, Some(both));
    let rig = wildcity_scene::Rig::preset("vehicle6");
    let rig = Edit { alignment: Alignment::IDENTITY, trajectories: Vec::new(), rig };
    let fifth = catalog.edit(&fourth, rig, &mut |_, _| {}).unwrap();
    assert_eq!(fifth.manifest.twin_from_capture, Some(both));
    // A rollback has that of the old version, and a new import none.
    assert_eq!(catalog.rollback("street", 2).unwrap().manifest.twin_from_capture, Some(one));
    assert_eq!(commit(&catalog, &gaussians(300, 0, 9.0, 3)).manifest.twin_from_capture, None);
    assert_eq!(catalog.diff("street", 1, 2).unwrap().settings, ["alignment"]);
}

/// Twins that were aligned before manifests had the alignment have it in their provenance.
#[test]
fn an_alignment_of_the_provenance_counts() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let mut old = commit(&catalog, &gaussians(300, 0, 10.0, 1));
    let [one, two] = [turn(DVec3::X, 2.0), turn(DVec3::Z, 0.25)];
    let options = ["axes=identity".to_owned(), format!("align={one}"), format!("align={two}")];
    old.manifest.provenance.options = options.to_vec();
    assert_eq!(old.manifest.alignment(), Ok(Some(two.after(&one))));
    let aligned = edit(&catalog, &old, one).unwrap();
    let all = aligned.manifest.twin_from_capture.unwrap();
    let p = DVec3::new(3.0, 4.0, -5.0);
    let wanted = one.point_m(two.point_m(one.point_m(p)));
    assert!(all.point_m(p).distance(wanted) < 1e-12, "{all}");
    let small = Alignment { metres_per_unit: 1e-4, ..Alignment::IDENTITY };
    for (unreadable, other) in [("align=1,2".to_owned(), two), (format!("align={small}"), small)] {
        old.manifest.provenance.options[1..]
            .clone_from_slice(&[unreadable, format!("align={other}")]);
        assert!(old.manifest.alignment().is_err(), "{:?}", old.manifest.provenance.options);
    }
}

/// A twin that was aligned before manifests had the alignment, and pushes of different cells at
/// once: the first one writes the alignment to the manifest, which is no alignment by others.
#[test]
fn changes_beside_each_other_keep_an_alignment_of_the_provenance() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let one = turn(DVec3::X, 2.0);
    let mut provenance = Provenance::new("test".into());
    provenance.options = vec![format!("align={one}")];
    let scene = gaussians(300, 0, 10.0, 1);
    let new = NewVersion::from_gaussians("street", &scene, provenance);
    let old = catalog.commit(new, &mut |_, _| {}).unwrap();
    assert_eq!(old.manifest.twin_from_capture, None);
    let [first, second] = [[0, 0], [5, 5]].map(|cell| change(&catalog, cell, 2));
    first.change(1, cells_alone()).unwrap();
    assert_eq!(catalog.diff("street", 1, 2).unwrap().settings, [""; 0]);
    let latest = second.change(1, cells_alone()).unwrap();
    assert_eq!((latest.number, latest.manifest.twin_from_capture), (3, Some(one)));
}

/// A push that was made before others aligned the twin would lie in the old axes, in whichever
/// cells.
#[test]
fn a_change_from_before_an_alignment_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let first = commit(&catalog, &gaussians(300, 0, 10.0, 1));
    let late = change(&catalog, [5, 5], 2);
    let aligned = edit(&catalog, &first, turn(DVec3::Z, 1.0)).unwrap();
    let error = late.change(1, cells_alone()).unwrap_err();
    let StoreError::Overlap { base: 1, latest: 2, cells, settings, .. } = &error else {
        panic!("{error}")
    };
    assert_eq!((&cells[..], &settings[..]), (&[][..], &["alignment"][..]));
    assert!(error.to_string().contains("alignment; make the change from version 2"), "{error}");
    // The same edit again, after a lost answer, is that version.
    assert_eq!(edit(&catalog, &first, turn(DVec3::Z, 1.0)).unwrap(), aligned);
    // From the aligned version it is accepted.
    let third = change(&catalog, [5, 5], 2).change(2, cells_alone()).unwrap();
    assert_eq!(third.number, 3);
}

#[test]
fn alignments_that_are_too_much_together_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let first = commit(&catalog, &gaussians(300, 0, 10.0, 1));
    let small = Alignment { metres_per_unit: 1e-4, ..Alignment::IDENTITY };
    let second = edit(&catalog, &first, small).unwrap();
    let error = edit(&catalog, &second, small).unwrap_err();
    assert!(matches!(error, StoreError::Alignment(_)), "{error}");
    // Together a move of 2e8 old units, which could not be read again.
    let mut far = Alignment::IDENTITY;
    far.new_from_old.position_m.z = 2e4;
    let error = edit(&catalog, &second, far).unwrap_err();
    assert!(matches!(error, StoreError::Alignment(_)), "{error}");
    assert_eq!(catalog.latest("street").unwrap(), 2);
    catalog.version("street", None).unwrap();
}
