//! Reads a manifest, and checks the rules that its types do not express. An error names the field
//! and the accepted values.

use std::path::Path;

use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::error::RepairError;
use crate::limits::{
    MAX_CONSTANT_VALUES, MAX_FILES, MAX_INPUTS, MAX_MULTIPLE_PX, MAX_SCALE, MAX_SIDE_PX,
    MAX_TIMEOUT_MS,
};
use crate::manifest::{Dtype, Fit, InputRole, Manifest, Merge, ModelFile, OutputRole, Provider};

/// The field that is wrong, and what is accepted.
pub(crate) type Checked = Result<(), (String, String)>;

impl Manifest {
    /// Reads and checks the text of a manifest; `file` is named in errors.
    ///
    /// # Errors
    /// [`RepairError::Manifest`] with the field that is wrong.
    pub fn parse(bytes: &[u8], file: &Path) -> Result<Manifest, RepairError> {
        read(bytes, file, Self::FORMAT, check)
    }
}

/// Reads a manifest of a format, and checks it. A file of another format is refused because of its
/// format, and not because of one of its fields.
pub(crate) fn read<T: DeserializeOwned>(
    bytes: &[u8],
    file: &Path,
    format: &str,
    check: fn(&T) -> Checked,
) -> Result<T, RepairError> {
    let wrong = |field: &str, message: String| RepairError::Manifest {
        file: file.to_owned(),
        field: field.to_owned(),
        message,
    };
    // Read twice: first as any JSON, for its format, then as this one's type.
    let value: Value = serde_json::from_slice(bytes).map_err(|error| {
        let must = "give the manifest, a JSON file beside the .onnx file (docs/repair.md)";
        wrong("manifest", format!("{error}; {must}"))
    })?;
    let found = value.get("format");
    if found.and_then(Value::as_str) != Some(format) {
        let found = found.map_or("missing".to_owned(), Value::to_string);
        return Err(wrong("format", format!("{found}; {format:?} is needed here")));
    }
    let mut reader = serde_json::Deserializer::from_slice(bytes);
    let manifest: T = serde_path_to_error::deserialize(&mut reader).map_err(|error| {
        let path = error.path().to_string();
        // The path of the whole file.
        let field = if path == "." { "manifest" } else { &path };
        wrong(field, error.inner().to_string())
    })?;
    check(&manifest).map_err(|(field, message)| wrong(&field, message))?;
    Ok(manifest)
}

/// Checks the rules that the types do not express. An error is the field and the accepted values.
fn check(manifest: &Manifest) -> Checked {
    check_name(&manifest.name)?;
    check_run(&manifest.providers, manifest.timeout_ms, manifest.memory_mib)?;
    check_files(&manifest.files)?;
    check_size(manifest)?;
    check_inputs(manifest)?;
    check_output(manifest)
}

/// The name of a model or network.
pub(crate) fn check_name(name: &str) -> Checked {
    let is_letter = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
    if name.is_empty() || name.len() > 64 || !name.chars().all(is_letter) {
        let message = format!("{name:?}; 1 to 64 letters, digits, '.', '_' and '-'");
        return Err(("name".to_owned(), message));
    }
    Ok(())
}

/// Checks the providers, the time-out and the memory.
pub(crate) fn check_run(providers: &[Provider], timeout_ms: u64, memory_mib: u32) -> Checked {
    let wrong = |field: &str, message: String| Err((field.to_owned(), message));
    if providers.is_empty() {
        return wrong("providers", "empty; name \"cpu\", \"cuda\" or \"tensorrt\"".to_owned());
    }
    if !(1..=MAX_TIMEOUT_MS).contains(&timeout_ms) {
        return wrong("timeout_ms", format!("{timeout_ms}; 1 to {MAX_TIMEOUT_MS}"));
    }
    if memory_mib == 0 {
        return wrong("memory_mib", "0; at least 1".to_owned());
    }
    Ok(())
}

/// Names and hashes of its files.
pub(crate) fn check_files(files: &[ModelFile]) -> Checked {
    if files.is_empty() || files.len() > MAX_FILES {
        let message = format!("{} files; name 1 to {MAX_FILES}, the .onnx file first", files.len());
        return Err(("files".to_owned(), message));
    }
    for (at, file) in files.iter().enumerate() {
        let is_name =
            // Equal to its own last part: no folder, no "..", nothing outside the
            // manifest's folder.
            Path::new(&file.path).file_name().is_some_and(|name| name == file.path.as_str());
        if !is_name {
            let message = format!("{:?}; the name of a file beside the manifest", file.path);
            return Err((format!("files[{at}].path"), message));
        }
        if blake3::Hash::from_hex(&file.blake3).is_err() {
            let message = format!("{:?}; 64 hexadecimal digits (`b3sum FILE`)", file.blake3);
            return Err((format!("files[{at}].blake3"), message));
        }
    }
    Ok(())
}

fn check_size(manifest: &Manifest) -> Checked {
    let wrong = |field: &str, message: String| Err((format!("size.{field}"), message));
    let size = &manifest.size;
    let is_side = |side: &u32| (1..=MAX_SIDE_PX as u32).contains(side);
    // Exactly one of the two; the first arms are the valid cases.
    let multiple = match (size.fixed, size.multiple_of) {
        (Some(sides), None) if sides.iter().all(is_side) => 1,
        (None, Some(multiple)) if (1..=MAX_MULTIPLE_PX).contains(&multiple) => multiple,
        (Some(sides), None) => {
            return wrong("fixed", format!("{sides:?}; [height, width] from 1 to {MAX_SIDE_PX}"));
        }
        (None, Some(multiple)) => {
            return wrong("multiple_of", format!("{multiple}; 1 to {MAX_MULTIPLE_PX}"));
        }
        _ => {
            return wrong(
                "fixed",
                "give either \"fixed\": [height, width] or \"multiple_of\"".to_owned(),
            );
        }
    };
    let needs_pixels = size.fit == Fit::Resize && size.fixed.is_none();
    // 2^28 pixels are a square of 16,384 px, the largest side.
    let is_count = size.pixels.is_some_and(|pixels| (1..=1 << 28).contains(&pixels));
    if needs_pixels && !is_count {
        return wrong("pixels", "needed with \"fit\": \"resize\": 1 to 268435456".to_owned());
    }
    if !needs_pixels && size.pixels.is_some() {
        return wrong(
            "pixels",
            "only with \"fit\": \"resize\" and \"multiple_of\"; remove it".to_owned(),
        );
    }
    let needs_tile = size.fit == Fit::Tile && size.fixed.is_none();
    let is_tile = |side: &u32| is_side(side) && side.is_multiple_of(multiple);
    if needs_tile && !size.tile.is_some_and(|sides| sides.iter().all(is_tile)) {
        return wrong(
            "tile",
            format!("needed with \"fit\": \"tile\": [height, width], multiples of {multiple}"),
        );
    }
    if !needs_tile && size.tile.is_some() {
        return wrong(
            "tile",
            "only with \"fit\": \"tile\" and \"multiple_of\"; remove it".to_owned(),
        );
    }
    Ok(())
}

fn check_inputs(manifest: &Manifest) -> Checked {
    if manifest.inputs.is_empty() || manifest.inputs.len() > MAX_INPUTS {
        let message = format!("{} inputs; 1 to {MAX_INPUTS}", manifest.inputs.len());
        return Err(("inputs".to_owned(), message));
    }
    let mut images = 0;
    for (at, input) in manifest.inputs.iter().enumerate() {
        let wrong =
            |field: &str, message: &str| Err((format!("inputs[{at}].{field}"), message.to_owned()));
        let is_constant = input.role == InputRole::Constant;
        // Exactly one image is repaired; others are references.
        images += usize::from(matches!(input.role, InputRole::Rgb | InputRole::Luma));
        if manifest.inputs[..at].iter().any(|other| other.name == input.name) {
            return wrong("name", "named twice; each input of the graph has one entry");
        }
        if !is_range(input.range) {
            return wrong("range", "[black, white]: two finite, different numbers");
        }
        // A value if and only if the role is `constant`; a NaN counts as no value.
        if is_constant != input.value.is_some_and(f64::is_finite)
            || (!is_constant && !input.shape.is_empty())
        {
            return wrong(
                "value",
                "a finite number, needed with the role \"constant\" and only there",
            );
        }
        // In f64: a product that is too large for it is infinite, and refused as well.
        let values: f64 = input.shape.iter().map(|side| f64::from(*side)).product();
        if values > MAX_CONSTANT_VALUES as f64 {
            return wrong("shape", "more than 1048576 values");
        }
        if input.dtype == Dtype::I64 && !is_constant {
            return wrong("dtype", "i64 only with the role \"constant\"; f32 or f16 here");
        }
    }
    if images != 1 {
        let message = format!("{images} have the role \"rgb\" or \"luma\"; exactly one must");
        return Err(("inputs".to_owned(), message));
    }
    Ok(())
}

fn check_output(manifest: &Manifest) -> Checked {
    let wrong =
        |field: &str, message: &str| Err((format!("outputs[0].{field}"), message.to_owned()));
    let [output] = &manifest.outputs[..] else {
        let message = format!("{} outputs; exactly one", manifest.outputs.len());
        return Err(("outputs".to_owned(), message));
    };
    if !is_range(output.range) {
        return wrong("range", "[black, white]: two finite, different numbers");
    }
    if !(1..=MAX_SCALE).contains(&output.scale) {
        return wrong("scale", "1 to 4");
    }
    let is_luma_in = manifest.image_input().role == InputRole::Luma;
    if (output.role == OutputRole::Luma) != is_luma_in {
        return wrong("role", "\"luma\" if and only if an input has the role \"luma\"");
    }
    let adds = output.role == OutputRole::Residual || manifest.merge == Merge::Residual;
    // The rendered image has no pixels between its own.
    if adds && output.scale != 1 {
        return wrong("scale", "1 with a residual: a larger image has nothing to add to");
    }
    if output.role == OutputRole::Residual && manifest.merge == Merge::Replace {
        return Err((
            "merge".to_owned(),
            "\"residual\" with the output role \"residual\"".to_owned(),
        ));
    }
    Ok(())
}

/// Whether two values can be the values of black and white.
pub(crate) fn is_range(range: [f32; 2]) -> bool {
    range.iter().all(|end| end.is_finite()) && range[0] != range[1]
}
