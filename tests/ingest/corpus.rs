//! One small scene in every format, which tests can damage beneath its checksums.

use std::path::Path;

use wildcity_scene::Gaussians;
use wildcity_twin::ingest::{self, IngestError};

use crate::format_files::{
    Files, glb, gltf, gzip, ksplat, nurec_plain, sog, splat, spz_plain, spz4, streamed, usdz, zip,
};
use crate::scene_files::{gaussians, gsplat_tensors, inria_columns, ply, safetensors};

/// A scene's files. The first one is the file that is given to the reader.
pub(crate) struct Case {
    pub(crate) name: &'static str,
    pub(crate) files: Files,
    /// Repairs the checksums of the first file after it was damaged.
    wrap: fn(Vec<u8>) -> Vec<u8>,
}

/// Number of Gaussians of every case.
pub(crate) const COUNT: usize = 6;

/// A scene of one file without a checksum.
pub(crate) fn one(name: &'static str, bytes: Vec<u8>) -> Case {
    Case { name, files: vec![("scene".into(), bytes)], wrap: |b| b }
}

/// A case of every format of splats.
pub(crate) fn corpus() -> Vec<Case> {
    let [flat, some, all] = [0, 1, 3].map(|degree| gaussians(COUNT, degree, 20.0, 9));
    let (json, buffer) = gltf(&some, r#","rotation":[0,1,0,0]"#, r#""uri":"splats.bin","#);
    let two = vec![("scene.gltf".to_owned(), json.into_bytes()), ("splats.bin".into(), buffer)];
    let whole = |name, files| Case { name, files, wrap: |b| b };
    vec![
        one("PLY", ply(&some, &inria_columns(1, false))),
        one("safetensors", safetensors(&gsplat_tensors(&some), &[])),
        one(".splat", splat(&flat)),
        one("plain SPZ 2", spz_plain(&some, 2)),
        Case { wrap: |b| gzip(&b), ..one("SPZ 3", spz_plain(&all, 3)) },
        one("gzip SPZ 3", gzip(&spz_plain(&some, 3))),
        one("SPZ 4", spz4(&some)),
        one(".ksplat 0", ksplat(&flat, 0)),
        one(".ksplat 2", ksplat(&some, 2)),
        one("GLB", glb(gltf(&some, "", ""))),
        whole("glTF", two),
        whole("SOG 1", sog(&some, 1)),
        whole("SOG 2", sog(&all, 2)),
        one("zip of SOG", zip(&sog(&flat, 2), true)),
        whole("streamed SOG", streamed()),
        Case { wrap: |b| usdz(b), ..one("NuRec", nurec_plain(&some, true)) },
        one("USDZ", usdz(nurec_plain(&flat, false))),
    ]
}

impl Case {
    /// Reads the case with one of its files replaced.
    pub(crate) fn read_with(
        &self,
        folder: &Path,
        part: usize,
        bytes: &[u8],
    ) -> Result<Gaussians, IngestError> {
        let wrapped = if part == 0 { (self.wrap)(bytes.to_vec()) } else { bytes.to_vec() };
        let path = folder.join(&self.files[part].0);
        std::fs::write(&path, wrapped).unwrap();
        ingest::read(&folder.join(&self.files[0].0), &mut |_, _| {})
    }

    /// Writes all files unchanged.
    pub(crate) fn write(&self, folder: &Path) {
        for (index, (name, bytes)) in self.files.iter().enumerate() {
            let path = folder.join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            let bytes = if index == 0 { (self.wrap)(bytes.clone()) } else { bytes.clone() };
            std::fs::write(path, bytes).unwrap();
        }
    }
}
