//! `wildcity repair`.

mod check;
mod sample;
mod warp_time;

/// Check ONNX models that repair images.
///
/// A model is an .onnx file with a manifest beside it (docs/repair.md). The ONNX runtime is a library of its
/// own, which --onnxruntime or ORT_DYLIB_PATH names; other commands do not load it.
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

#[derive(Debug, clap::Subcommand)]
enum Subcommand {
    Check(check::Check),
}

impl Repair {
    pub(super) fn run(self) -> anyhow::Result<()> {
        match self.subcommand {
            Subcommand::Check(check) => check.run(),
        }
    }
}
