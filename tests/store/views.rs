//! Recorded images of a version: kept, shared, turned, damaged, collected.

use std::time::Duration;

use glam::DVec3;
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::views::RecordedView;
use wildcity_twin::store::{
    Catalog, Commit, CommitKind, Edit, Retention, StorageOptions, StoreError, Version,
};

use crate::places::{Place, cells_alone, change, commit, everywhere};
use crate::scene_files::gaussians;

const IMAGES: [&[u8]; 2] = [b"the first image", b"the second image, which is longer"];

/// Of the second image.
const MASK: &[u8] = b"what counts";

fn begin(catalog: &Catalog) -> Commit {
    catalog.begin("street", CommitKind::Import, StorageOptions::default()).unwrap()
}

fn table(commit: &mut Commit) -> Vec<RecordedView> {
    let pinhole = Pinhole { fx: 100.0, fy: 100.0, cx: 50.0, cy: 40.0 };
    let view = |(at, image): (usize, &&[u8])| RecordedView {
        trajectory: "log".to_owned(),
        station_m: 2.0 * at as f64,
        camera_name: "front".to_owned(),
        camera: Camera::from_pinhole(100, 80, pinhole),
        world_from_camera: Pose {
            position_m: DVec3::new(2.0 * at as f64, 0.5, 1.5),
            ..Pose::IDENTITY
        },
        exposure_stops: None,
        image: commit.put_image(image).unwrap(),
        mask: (at == 1).then(|| commit.put_image(MASK).unwrap()),
    };
    IMAGES.iter().enumerate().map(view).collect()
}

/// A second version, with images.
fn with_views(catalog: &Catalog) -> (Version, Vec<RecordedView>) {
    let first = catalog.version("street", None).unwrap();
    let mut commit = begin(catalog);
    let views = table(&mut commit);
    let named = commit.put_views(&views).unwrap();
    commit.set_views(Some(named));
    (commit.change(first.number, cells_alone()).unwrap(), views)
}

fn street(place: &Place) -> Catalog {
    let catalog = place.catalog();
    commit(&catalog, &gaussians(300, 0, 10.0, 1));
    catalog
}

#[test]
fn images_come_back_and_later_versions_share_them() {
    everywhere(|place| {
        let catalog = street(place);
        let first = catalog.version("street", None).unwrap();
        assert_eq!((catalog.views(&first).unwrap().len(), &first.manifest.views), (0, &None));
        let (second, views) = with_views(&catalog);
        let named = second.manifest.views.clone().unwrap();
        assert_eq!((named.images, named.image_bytes), (2, 15 + 33 + 11));
        assert_eq!(
            second.manifest.stored_bytes(),
            first.manifest.stored_bytes() + 59 + named.bytes
        );
        assert_eq!(catalog.views(&second).unwrap(), views);
        for (view, image) in views.iter().zip(IMAGES) {
            assert_eq!(catalog.view_image(&second, view).unwrap(), image);
        }
        let masks = views.iter().map(|view| catalog.view_mask(&second, view).unwrap());
        assert_eq!(masks.collect::<Vec<_>>(), [None, Some(MASK.to_vec())]);
        // Another change keeps them, and the same images take no room.
        let objects = place.objects().len();
        let third = change(&catalog, [0, 0], 2).change(second.number, cells_alone()).unwrap();
        assert_eq!(third.manifest.views.as_ref(), Some(&named));
        let mut again = begin(&catalog);
        let same = table(&mut again);
        assert_eq!(again.put_views(&same).unwrap(), named);
        drop(again);
        // Cell, table of sections, manifest.
        assert_eq!(place.objects().len(), objects + 3);
        assert!(catalog.fsck("street", &mut |_, _| {}).unwrap().is_sound());

        let mut removing = begin(&catalog);
        removing.set_views(None);
        let fourth = removing.change(third.number, cells_alone()).unwrap();
        assert_eq!(fourth.manifest.views, None);
        assert_eq!(catalog.rollback("street", third.number).unwrap().manifest.views, Some(named));
    });
}

#[test]
fn a_copy_of_a_twin_has_images_of_its_own() {
    everywhere(|place| {
        let catalog = street(place);
        let (second, views) = with_views(&catalog);
        let copied = catalog.copy("street", None, "avenue").unwrap();
        catalog.remove("street").unwrap();
        assert_eq!(copied.manifest.views, second.manifest.views);
        assert_eq!(catalog.views(&copied).unwrap(), views);
        for (view, bytes) in views.iter().zip(IMAGES) {
            assert_eq!(catalog.view_image(&copied, view).unwrap(), bytes);
        }
        assert_eq!(catalog.view_mask(&copied, &views[1]).unwrap().as_deref(), Some(MASK));
        assert!(catalog.verify("avenue", &mut |_, _| {}).unwrap().damaged.is_empty());
    });
}

#[test]
fn images_are_garbage_with_their_last_version() {
    everywhere(|place| {
        let catalog = street(place);
        let (second, views) = with_views(&catalog);
        let mut removing = begin(&catalog);
        removing.set_views(None);
        removing.change(second.number, cells_alone()).unwrap();
        let keep = |versions| Retention { versions, grace: Duration::ZERO };
        let collect = |versions| {
            // The first run notes garbage, the second removes it.
            catalog.collect("street", keep(versions), false).unwrap();
            catalog.collect("street", keep(versions), false).unwrap()
        };
        // The third version is the first one again, so with two versions all is needed.
        let kept = collect(2).removed;
        assert_eq!(kept.objects, 0, "{kept:?}");
        assert_eq!(catalog.view_image(&second, &views[1]).unwrap(), IMAGES[1]);
        assert_eq!(catalog.view_mask(&second, &views[1]).unwrap(), Some(MASK.to_vec()));
        let removed = collect(1).removed;
        // Two images, a mask, their table and a manifest.
        assert_eq!(removed.objects, 5, "{removed:?}");
        catalog.view_mask(&second, &views[1]).unwrap_err();
        catalog.view_image(&second, &views[1]).unwrap_err();
        assert!(catalog.fsck("street", &mut |_, _| {}).unwrap().is_sound());
    });
}

#[test]
fn a_damaged_image_or_table_is_found() {
    let dir = tempfile::tempdir().unwrap();
    let place = Place::Directory(dir);
    let catalog = street(&place);
    let (second, views) = with_views(&catalog);
    let table = second.manifest.views.as_ref().unwrap().object.clone();
    let mask = &views[1].mask.as_ref().unwrap().object;
    for object in [&views[0].image.object, mask, &table] {
        let path = place.twins().join("street/objects").join(&object[..2]).join(object);
        let before = std::fs::read(&path).unwrap();
        let mut permissions = std::fs::metadata(&path).unwrap().permissions();
        #[allow(clippy::permissions_set_readonly_false, reason = "of a temporary file")]
        permissions.set_readonly(false);
        std::fs::set_permissions(&path, permissions).unwrap();
        let mut spoilt = before.clone();
        spoilt[3] ^= 1;
        std::fs::write(&path, &spoilt).unwrap();
        let report = catalog.fsck("street", &mut |_, _| {}).unwrap();
        let damaged: Vec<_> = report.verified.damaged.iter().map(|one| &one.object).collect();
        assert_eq!(damaged, [object]);
        std::fs::write(&path, &before).unwrap();
    }
    let cannot = catalog.view_image(&second, &views[0]);
    assert_eq!(cannot.unwrap(), IMAGES[0], "after the repair");
    assert!(catalog.fsck("street", &mut |_, _| {}).unwrap().is_sound());
}

#[test]
fn an_alignment_moves_the_images_with_the_world() {
    let place = Place::Directory(tempfile::tempdir().unwrap());
    let catalog = street(&place);
    let (second, views) = with_views(&catalog);
    let new_from_old =
        Pose { position_m: DVec3::new(1.0, 2.0, 3.0), rotation: glam::DQuat::from_rotation_z(0.3) };
    let alignment = Alignment { new_from_old, metres_per_unit: 2.0 };
    let edit = Edit { alignment, trajectories: Vec::new(), rig: None };
    let third = catalog.edit(&second, edit, &mut |_, _| {}).unwrap();
    for (moved, view) in catalog.views(&third).unwrap().iter().zip(&views) {
        let wanted = alignment.pose(&view.world_from_camera);
        assert!(moved.world_from_camera.position_m.distance(wanted.position_m) < 1e-12);
        assert_eq!(moved.station_m, 2.0 * view.station_m);
        assert_eq!(catalog.view_image(&third, moved).unwrap().len() as u64, moved.image.bytes);
    }
}

#[test]
fn an_image_that_could_not_be_read_again_is_refused() {
    let place = Place::Directory(tempfile::tempdir().unwrap());
    let catalog = street(&place);
    let large = vec![0; (64 << 20) + 1];
    let error = begin(&catalog).put_image(&large).unwrap_err();
    assert!(matches!(error, StoreError::ViewSize { what: "image", .. }), "{error}");
}
