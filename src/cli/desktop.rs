//! Machines without a desktop.

use std::env;
use std::os::unix::process::CommandExt as _;
use std::process::Command;

/// Starts this program once more without Mesa's layer that selects a device, if there is no desktop.
///
/// The layer asks the desktop for its device whenever Vulkan is opened, and prints `error: XDG_RUNTIME_DIR is invalid or
/// not set` if there is none. An environment variable disables it. Setting one in a running program is `unsafe`, since
/// other threads may read the environment.
pub(super) fn start_without_device_selection() {
    const DISABLE: &str = "NODEVICE_SELECT";
    if env::var_os("XDG_RUNTIME_DIR").is_some() || env::var_os(DISABLE).is_some() {
        return;
    }
    let mut arguments = env::args_os();
    let (Ok(program), Some(name)) = (env::current_exe(), arguments.next()) else { return };
    // It returns only if the program could not be started. This one then goes on, with the lines of the layer.
    let _ = Command::new(program).arg0(name).args(arguments).env(DISABLE, "1").exec();
}
