//! The checks of a server's configuration that `wildcity doctor --config` makes.

use std::ffi::OsString;
use std::fs::{self, OpenOptions};
use std::net::TcpListener;
use std::path::Path;
use std::time::SystemTime;

use wildcity_server::{TlsFiles, Tokens};

use crate::cli::directories::ServerDirectories;
use crate::cli::{exit, output};

use super::{Serve, config_file};

/// The subject of a check, and its result: a confirmation, or the reason why it failed.
pub(in crate::cli) type Check = (&'static str, Result<String, String>);

impl Serve {
    /// The options of a file, as `wildcity serve --config FILE` has them.
    ///
    /// # Errors
    /// The file cannot be read, has an unknown key or a value that the option refuses.
    pub(in crate::cli) fn from_file(file: &Path) -> anyhow::Result<Self> {
        // One argument with a sign of equality: a path that begins with a dash is no option then.
        let mut argument = OsString::from("--config=");
        argument.push(file);
        Ok(config_file::resolve(vec![argument])?.serve)
    }

    /// The directories of the server.
    pub(in crate::cli) fn directories(&self) -> &ServerDirectories {
        &self.directories
    }

    /// The file of the tokens.
    pub(in crate::cli) fn tokens_file(&self) -> Option<&Path> {
        self.tokens.as_deref()
    }

    /// Checks the address and every file that the server reads or writes outside of its
    /// directories. Changes nothing.
    pub(in crate::cli) fn checks(&self) -> Vec<Check> {
        let mut checks = vec![("listen", self.check_listen())];
        if let Some(path) = &self.tokens {
            let found = Tokens::read(path).map(|_| format!("{} can be used", path.display()));
            checks.push(("tokens", found.map_err(|error| format!("{}: {error}", path.display()))));
        }
        match (&self.tls_cert, &self.tls_key) {
            (Some(cert), Some(key)) => {
                let files = TlsFiles { cert: cert.clone(), key: key.clone() };
                checks.push(("certificate", check_certificate(&files)));
            }
            (None, None) => {}
            _ => {
                let wrong = "tls_cert and tls_key need each other".to_owned();
                checks.push(("certificate", Err(wrong)));
            }
        }
        if let Some(path) = &self.audit_log {
            checks.push(("audit log", check_audit_log(path)));
        }
        checks.push(("scenarios", self.check_scenarios()));
        checks
    }

    fn check_listen(&self) -> Result<String, String> {
        let listen = self.listen;
        if self.tokens.is_none() && !listen.ip().is_loopback() {
            return Err(format!("{listen} is not a loopback address, and needs tokens"));
        }
        // The listener is dropped at once, and the port is free again.
        match TcpListener::bind(listen) {
            Ok(_) => Ok(format!("{listen} is free")),
            Err(error) => Err(format!("{listen}: {error}; a server may run already")),
        }
    }

    fn check_scenarios(&self) -> Result<String, String> {
        let dir = self.directories.scenarios.dir().map_err(|error| exit::chain(&error))?;
        let shown = dir.display();
        if !dir.exists() {
            return Ok(format!("there is no {shown}: none can be opened by name"));
        }
        let entries = fs::read_dir(&dir).map_err(|error| format!("{shown}: {error}"))?;
        let is_file = |name: &Path| name.extension().is_some_and(|extension| extension == "json");
        let count =
            entries.filter(|entry| entry.as_ref().is_ok_and(|entry| is_file(&entry.path())));
        let files = output::counted(count.count(), "file");
        Ok(format!("{files} in {shown}; `wildcity scenario check` reads one"))
    }
}

fn check_certificate(files: &TlsFiles) -> Result<String, String> {
    let expires = files.check().map_err(|error| error.to_string())?;
    let shown = files.cert.display();
    match expires.duration_since(SystemTime::now()) {
        Ok(left) => {
            Ok(format!("{shown} is that of the key, and good for {} days", left.as_secs() / 86_400))
        }
        Err(over) => {
            let days = over.duration().as_secs() / 86_400;
            Err(format!("{shown} expired {days} days ago: renew it"))
        }
    }
}

fn check_audit_log(path: &Path) -> Result<String, String> {
    let shown = path.display();
    let written = if path.exists() {
        OpenOptions::new().append(true).open(path).map(drop)
    } else {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        // A file without a name tells whether the folder can be written, and leaves nothing there.
        tempfile::tempfile_in(folder.unwrap_or(Path::new("."))).map(drop)
    };
    match written {
        Ok(()) => Ok(format!("{shown} can be written")),
        Err(error) => Err(format!("{shown} cannot be written: {error}")),
    }
}
