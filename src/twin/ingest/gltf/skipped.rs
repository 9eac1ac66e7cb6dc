//! Warns of parts of a document that change the picture and are not read.

use std::collections::BTreeSet;

use crate::ingest::notes::Reading;

use super::document::{Document, Primitive};
use super::instances::MeshInstance;
use super::{EXTENSION, READ_EXTENSIONS};
use wildcity_scene::sh;

/// Warns of parts of the document that are not read.
pub(super) fn check(document: &Document, placed: &[MeshInstance<'_>], reading: &mut Reading) {
    if !document.animations.is_empty() {
        reading.warn(format!(
            "animations ({}) are not read: the scene is drawn as it is stored",
            document.animations.len()
        ));
    }
    let mut extensions = BTreeSet::new();
    let mut skinned = Vec::new();
    for (index, node) in document.nodes.iter().enumerate() {
        extensions.extend(node.extensions.keys().map(|name| format!("{name} (node {index})")));
        skinned.extend(node.skin.is_some().then(|| format!("node {index}")));
    }
    warn(reading, "extensions of nodes", extensions);
    warn(reading, "skins", skinned);
    let mut primitives = Vec::new();
    for placed in placed {
        for (index, primitive) in placed.mesh.primitives.iter().enumerate() {
            primitives.push((format!("node {}, primitive {index}", placed.node), primitive));
        }
    }
    let has_splats = |primitive: &Primitive| primitive.extensions.contains_key(EXTENSION);
    let any_splats = primitives.iter().any(|(_, primitive)| has_splats(primitive));
    let mut meshes = Vec::new();
    let mut unread = BTreeSet::new();
    let mut attributes = BTreeSet::new();
    let mut targets = Vec::new();
    for (place, primitive) in primitives {
        // With splats in the scene, its triangles are not drawn.
        if any_splats && !has_splats(primitive) {
            meshes.push(place);
            continue;
        }
        targets.extend((!primitive.targets.is_empty()).then_some(place));
        let names = primitive.extensions.keys();
        unread.extend(names.filter(|name| !READ_EXTENSIONS.contains(&name.as_str())).cloned());
        if has_splats(primitive) {
            attributes.extend(primitive.attributes.keys().filter(|name| !is_read(name)).cloned());
        }
    }
    warn(reading, "meshes beside the splats", meshes);
    warn(reading, "extensions of primitives", unread);
    warn(reading, "attributes", attributes);
    warn(reading, "morph targets", targets);
}

/// Warns of parts of one kind, if there are any.
fn warn(reading: &mut Reading, kind: &str, names: impl IntoIterator<Item = String>) {
    let names: Vec<String> = names.into_iter().collect();
    if !names.is_empty() {
        reading.warn_skipped(kind, &names.iter().map(String::as_str).collect::<Vec<_>>());
    }
}

/// Whether an attribute of splats is read. COLOR_0 is what other programs draw in place of SH.
fn is_read(name: &str) -> bool {
    if ["POSITION", "COLOR_0"].contains(&name) {
        return true;
    }
    let own = name.strip_prefix(EXTENSION).and_then(|rest| rest.strip_prefix(':'));
    own.is_some_and(|own| {
        let degrees = 0..=sh::MAX_DEGREE;
        ["ROTATION", "SCALE", "OPACITY"].contains(&own)
            || degrees.into_iter().any(|l| own.starts_with(&format!("SH_DEGREE_{l}_COEF_")))
    })
}
