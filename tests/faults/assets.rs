//! Assets of actors on a disk that fails to read: a failure hides no other asset, and gives no name
//! away.

use std::path::Path;
use std::sync::Arc;

use wildcity_scene::actor::{ActorAsset, AssetDescription};
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{ActorBox, ActorClass, Gaussians, RecordFormat};
use wildcity_twin::store::{ActorList, Catalog, SameName, StoreError};

use crate::disk::{ROOT, SimClock, SimDisk};
use crate::reads::{BadReads, ReadFault};

fn asset(name: &str, count: usize) -> ActorAsset {
    let mut gaussians = Gaussians::default();
    for index in 0..count {
        gaussians.means_m.push([0.1 * index as f64, 0.0, 0.5]);
        gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.ln_scales.push([-1.0; 3]);
        gaussians.logit_opacities.push(0.0);
        gaussians.sh.extend([0.0; 3]);
    }
    let description = AssetDescription {
        name: name.to_owned(),
        class: ActorClass::Object,
        box_: ActorBox { length_m: 1.0, width_m: 1.0, height_m: 1.0 },
        provenance: Provenance::new("test".to_owned()),
    };
    ActorAsset::new(&gaussians, description).unwrap()
}

#[test]
fn a_read_that_fails_hides_no_other_asset() {
    let clock = Arc::new(SimClock::new());
    let disk = Arc::new(SimDisk::new(clock.clone(), None));
    let catalog = Catalog::on(Path::new(ROOT), disk.clone(), clock).unwrap();
    let put = |(name, count): (&str, usize)| {
        catalog.put_actor(&asset(name, count), RecordFormat::F32).unwrap()
    };
    let stored = [("bus", 3), ("car", 4), ("van", 5)].map(put);
    let hidden = |list: &ActorList| -> Vec<String> {
        let is_hidden = |hash: &&String| list.actors.iter().all(|actor| actor.hash != **hash);
        stored.iter().map(|actor| &actor.hash).filter(is_hidden).cloned().collect()
    };
    let mut folders = 0;
    // The first read lists the folder of all assets, and there is a last one.
    for after in 1..1_000 {
        // A folder that cannot be listed is looked at once more.
        for times in [1, 2] {
            let fail = || {
                let reads = BadReads { after, fault: ReadFault::Error, times };
                disk.set_bad_reads(Some(reads));
                disk.take_failed_reads();
            };
            fail();
            let list = catalog.actors().unwrap();
            if disk.take_failed_reads() == 0 {
                assert!(folders >= 3, "{folders} folders failed");
                assert_eq!(list.actors, stored);
                return;
            }
            assert!(!list.damaged.is_empty() && list.damaged.len() <= times as usize, "{list:?}");
            for hash in hidden(&list) {
                let is_told = |digits: &String| hash.starts_with(digits);
                assert!(list.damaged.iter().any(|one| is_told(&one.hash)), "{hash}: {list:?}");
            }
            for damaged in &list.damaged {
                folders += usize::from(damaged.hash.len() == 2);
                assert!(damaged.reason.contains("Input/output error"), "{damaged:?}");
                assert!(!damaged.reason.contains(ROOT), "{damaged:?}");
            }
            // An asset that is not read may have any name.
            fail();
            let found = catalog.find_actor("car");
            assert!(matches!(found, Err(StoreError::Io { .. })), "{after}: {found:?}");
            fail();
            let added = catalog.add_actor(&asset("bike", 6), RecordFormat::F32, SameName::Refused);
            let is_undone = matches!(added, Err(StoreError::Io { .. }));
            disk.set_bad_reads(None);
            if !is_undone {
                // Where reads are counted, an addition makes others than a list.
                catalog.remove_actor(&added.unwrap().actor.hash, false).unwrap();
            }
            assert_eq!(catalog.actors().unwrap().actors, stored);
        }
    }
    panic!("reads never end");
}
