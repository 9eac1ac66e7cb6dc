//! Scenes as glTF with KHR_gaussian_splatting.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use wildcity_scene::Gaussians;

/// `opacity = sigmoid(logit)`.
pub(crate) fn opacity(logit: f32) -> f64 {
    1.0 / (1.0 + (-f64::from(logit)).exp())
}

pub(crate) fn unit(q: [f32; 4]) -> [f64; 4] {
    let q = q.map(f64::from);
    let length = q.iter().map(|q| q * q).sum::<f64>().sqrt();
    q.map(|q| q / length)
}

/// The attributes of KHR_gaussian_splatting: name, numbers per row, all of them in order.
fn gltf_attributes(g: &Gaussians) -> Vec<(String, usize, Vec<f32>)> {
    let own = |name: &str| format!("KHR_gaussian_splatting:{name}");
    let quats = g.quats_wxyz.iter().flat_map(|&q| {
        let [w, x, y, z] = unit(q);
        [x, y, z, w].map(|q| q as f32)
    });
    let mut attributes = vec![
        ("POSITION".to_owned(), 3, g.means_m.as_flattened().iter().map(|&m| m as f32).collect()),
        (own("ROTATION"), 4, quats.collect()),
        (own("SCALE"), 3, g.ln_scales.as_flattened().iter().map(|ln| ln.exp()).collect()),
        (own("OPACITY"), 1, g.logit_opacities.iter().map(|&l| opacity(l) as f32).collect()),
    ];
    for degree in 0..=usize::from(g.sh_degree) {
        for n in 0..2 * degree + 1 {
            let first = 3 * (degree * degree + n);
            let colour = (0..g.len()).flat_map(|i| g.sh_at(i)[first..first + 3].to_vec());
            attributes.push((own(&format!("SH_DEGREE_{degree}_COEF_{n}")), 3, colour.collect()));
        }
    }
    attributes
}

/// A glTF document and its buffer. `node` is the JSON inside of the only node, `uri` the URI of the
/// buffer.
pub(crate) fn gltf(g: &Gaussians, node: &str, uri: &str) -> (String, Vec<u8>) {
    let (mut buffer, mut views, mut accessors, mut names) = (Vec::new(), vec![], vec![], vec![]);
    for (index, (name, width, values)) in gltf_attributes(g).into_iter().enumerate() {
        let start = buffer.len();
        values.iter().for_each(|value| buffer.extend(value.to_le_bytes()));
        let length = buffer.len() - start;
        views.push(format!(r#"{{"buffer":0,"byteOffset":{start},"byteLength":{length}}}"#));
        let kind = ["SCALAR", "", "VEC3", "VEC4"][width - 1];
        accessors.push(format!(
            r#"{{"bufferView":{index},"componentType":5126,"count":{},"type":"{kind}"}}"#,
            g.len()
        ));
        names.push(format!(r#""{name}":{index}"#));
    }
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0{node}}}],
        "meshes":[{{"primitives":[{{"attributes":{{{}}},
        "extensions":{{"KHR_gaussian_splatting":{{"kernel":"ellipse"}}}}}}]}}],
        "accessors":[{}],"bufferViews":[{}],"buffers":[{{{uri}"byteLength":{}}}]}}"#,
        names.join(","),
        accessors.join(","),
        views.join(","),
        buffer.len()
    );
    (json, buffer)
}

/// A binary glTF file of a document and its buffer.
pub(crate) fn glb((json, mut buffer): (String, Vec<u8>)) -> Vec<u8> {
    let mut json = json.into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    buffer.resize(buffer.len().next_multiple_of(4), 0);
    let length = 12 + 8 + json.len() + 8 + buffer.len();
    let word = |value: usize| (value as u32).to_le_bytes();
    let parts: [&[u8]; 9] = [
        b"glTF",
        &word(2),
        &word(length),
        &word(json.len()),
        b"JSON",
        &json,
        &word(buffer.len()),
        b"BIN\0",
        &buffer,
    ];
    parts.concat()
}
