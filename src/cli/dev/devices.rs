//! `wildcity dev devices`.

use std::io::Write;

use serde_json::json;

use crate::cli::output;
use wildcity_render::gpu::{DeviceInfo, NO_DEVICE, devices};

/// List the devices that the gpu backend can use, the fastest kind first.
///
/// --device takes the number or a part of the name. A device of the kind "cpu" is software
/// (lavapipe): its images are right, but it is slower than the cpu backend, so --backend auto never
/// selects it.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Devices {
    /// Print one JSON array on standard output.
    #[arg(long)]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  wildcity dev devices
  wildcity dev devices --json | jq '.[0].name'";

impl Devices {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let devices = devices();
        let mut out = output::stdout();
        if self.json {
            let devices: Vec<_> = devices.iter().map(device_json).collect();
            writeln!(out, "{}", json!(devices))?;
            return Ok(());
        }
        if devices.is_empty() {
            writeln!(out, "{NO_DEVICE}")?;
        }
        for (number, device) in devices.iter().enumerate() {
            let DeviceInfo { name, kind, driver, .. } = device;
            let mib = |bytes: u64| bytes >> 20;
            writeln!(out, "{number}  {name} ({kind})")?;
            writeln!(out, "   driver           {driver}")?;
            writeln!(out, "   largest binding  {} MiB", mib(device.binding_bytes))?;
            writeln!(out, "   largest buffer   {} MiB", mib(device.buffer_bytes))?;
            writeln!(
                out,
                "   workgroups       {} threads, {} KiB, {} per dimension",
                device.workgroup_threads,
                device.workgroup_bytes >> 10,
                device.groups_per_dimension
            )?;
            writeln!(out, "   subgroups        {:?} threads", device.subgroup_threads)?;
            writeln!(out, "   stage times      {}", if device.has_clock { "yes" } else { "no" })?;
        }
        Ok(())
    }
}

fn device_json(device: &DeviceInfo) -> serde_json::Value {
    json!({
        "name": device.name,
        "kind": device.kind,
        "driver": device.driver,
        "binding_bytes": device.binding_bytes,
        "buffer_bytes": device.buffer_bytes,
        "workgroup_threads": device.workgroup_threads,
        "workgroup_bytes": device.workgroup_bytes,
        "groups_per_dimension": device.groups_per_dimension,
        "subgroup_threads": [device.subgroup_threads.start(), device.subgroup_threads.end()],
        "has_clock": device.has_clock,
    })
}
