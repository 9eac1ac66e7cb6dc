//! Mesh instances: the meshes of the scene's nodes, with their transforms.

use glam::{DMat3, DMat4, DQuat, DVec3};

use crate::ingest::{Axes, IngestError};
use wildcity_scene::Gaussians;

use super::bad;
use super::document::{Document, Mesh, Node};

/// A node's mesh.
pub(super) struct MeshInstance<'a> {
    pub(super) node: usize,
    /// Index of the mesh in the document.
    pub(super) index: usize,
    pub(super) mesh: &'a Mesh,
    pub(super) scene_from_mesh: DMat4,
}

/// All mesh instances of the scene, in depth-first order.
pub(super) fn mesh_instances(document: &Document) -> Result<Vec<MeshInstance<'_>>, IngestError> {
    let scene = document.scenes.get(document.scene.unwrap_or(0));
    // Without scenes, every node that is not a child of another is a root.
    let roots = scene.map_or_else(|| roots(document), |scene| scene.nodes.clone());
    let mut waiting: Vec<_> = roots.into_iter().rev().map(|node| (node, DMat4::IDENTITY)).collect();
    let mut seen = vec![false; document.nodes.len()];
    let mut placed = Vec::new();
    while let Some((index, scene_from_parent)) = waiting.pop() {
        let place = format!("node {index}");
        let node = document.nodes.get(index).ok_or_else(|| bad(&place, "does not exist".into()))?;
        if std::mem::replace(&mut seen[index], true) {
            return Err(bad(
                &place,
                "is reached twice; in a tree, each node has one parent".into(),
            ));
        }
        let scene_from_mesh = scene_from_parent * parent_from_node(node);
        // Reversed, because the last one that is pushed is the first to be visited.
        waiting.extend(node.children.iter().rev().map(|&child| (child, scene_from_mesh)));
        if let Some(own) = node.mesh {
            let mesh = document
                .meshes
                .get(own)
                .ok_or_else(|| bad(&place, "its mesh does not exist".into()))?;
            placed.push(MeshInstance { node: index, index: own, mesh, scene_from_mesh });
        }
    }
    Ok(placed)
}

fn roots(document: &Document) -> Vec<usize> {
    let mut is_root = vec![true; document.nodes.len()];
    for &child in document.nodes.iter().flat_map(|node| &node.children) {
        if let Some(is_root) = is_root.get_mut(child) {
            *is_root = false;
        }
    }
    (0..is_root.len()).filter(|&node| is_root[node]).collect()
}

fn parent_from_node(node: &Node) -> DMat4 {
    if let Some(matrix) = &node.matrix {
        return DMat4::from_cols_array(matrix);
    }
    DMat4::from_scale_rotation_translation(
        DVec3::from_array(node.scale.unwrap_or([1.0; 3])),
        DQuat::from_array(node.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0])),
        DVec3::from_array(node.translation.unwrap_or([0.0; 3])),
    )
}

impl MeshInstance<'_> {
    /// Transforms Gaussians of the mesh to the scene. The identity changes no bit.
    pub(super) fn apply(&self, gaussians: &mut Gaussians) -> Result<(), IngestError> {
        if self.scene_from_mesh == DMat4::IDENTITY {
            return Ok(());
        }
        let turn = DMat3::from_mat4(self.scene_from_mesh);
        // A uniform scale s has the determinant s³, and a reflection changes only its sign.
        let scale = turn.determinant().abs().cbrt();
        let rows = (turn * scale.recip()).transpose().to_cols_array_2d();
        let found = Axes::from_rows(rows).and_then(|axes| axes.scaled(scale));
        let axes = found.map_err(|_| {
            let reason = "its matrix is not a rotation, perhaps with a reflection and a uniform scale from 1e-6 to 1e6; bake \
                          it into the splats";
            bad(&format!("node {}", self.node), reason.into())
        })?;
        axes.apply(gaussians);
        let moved_m = self.scene_from_mesh.w_axis.truncate();
        for mean_m in &mut gaussians.means_m {
            *mean_m = (DVec3::from_array(*mean_m) + moved_m).to_array();
        }
        Ok(())
    }
}
