//! `wildcity repair`.

mod check;
mod sample;
mod warp_time;

/// Check ONNX models that repair images.
///
/// A model is an .onnx file with a manifest next to it (docs/repair.md). ONNX Runtime is a separate
/// library, which --onnxruntime or $ORT_DYLIB_PATH names; it is loaded only to run a model.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  pip install onnxruntime           (has onnxruntime/capi/libonnxruntime.so.1.*)
  export ORT_DYLIB_PATH=.../onnxruntime/capi/libonnxruntime.so.1.32.0
  wildcity repair check model.json
  wildcity repair check model.json --image street.png --out pictures")]
pub(super) struct Repair {
    #[command(subcommand)]
    subcommand: Subcommand,
}

super::subcommands! {
    Subcommand;
    Check(check::Check),
}

impl Repair {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.subcommand.run()
    }
}
