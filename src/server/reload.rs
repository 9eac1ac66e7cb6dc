//! Reading the certificate and the tokens again at SIGHUP.

use std::sync::Arc;

use crate::state::ServerState;
use crate::tls::Tls;

/// Reads both again with every SIGHUP, until dropped. Existing connections keep their certificate
/// and the rights of their token. If a file cannot be used, the old values stay. After the call,
/// SIGHUP does not end the process.
pub(crate) fn reload(
    tls: Option<Arc<Tls>>,
    state: Arc<ServerState>,
) -> impl Future<Output = ()> + Send {
    // Outside of the future: from here on SIGHUP does not end the process, even if the future is
    // polled later.
    #[cfg(unix)]
    let hangup = {
        use tokio::signal::unix::{SignalKind, signal};
        signal(SignalKind::hangup())
    };
    async move {
        #[cfg(unix)]
        match hangup {
            Ok(mut hangup) => {
                while hangup.recv().await.is_some() {
                    let shared = (tls.clone(), state.clone());
                    // Files are read and keys are parsed, neither of which an async thread must do.
                    let read = move || read_again(shared.0.as_deref(), &shared.1);
                    if tokio::task::spawn_blocking(read).await.is_err() {
                        tracing::error!("SIGHUP: reading again crashed");
                    }
                    state.metrics.reloads.inc();
                }
            }
            Err(error) => tracing::error!("SIGHUP reads nothing again: {error}"),
        }
        #[cfg(not(unix))]
        drop((tls, state));
        // The caller selects over this future, so it must not end.
        std::future::pending().await
    }
}

#[cfg(unix)]
fn read_again(tls: Option<&Tls>, state: &ServerState) {
    if let Some(tls) = tls {
        tls.read_again();
    }
    match state.tokens.as_ref().map(|tokens| tokens.read_again()) {
        Some(Ok(Some(file))) => tracing::info!(file = %file.display(), "read the tokens again"),
        Some(Err((file, error))) => {
            tracing::error!(file = %file.display(), "the old tokens stay: {error}");
        }
        // Said once if there was neither, or an operator would wait for an effect.
        Some(Ok(None)) | None if tls.is_none() => {
            tracing::info!(
                "SIGHUP: there is nothing to read again, neither a certificate nor tokens"
            );
        }
        Some(Ok(None)) | None => {}
    }
}
