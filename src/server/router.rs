//! HTTP routes, and the upgrade to WebSocket.

use std::sync::Arc;

use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse as _, Response};
use axum::routing::{get, post};
use axum::{Extension, Json, Router};
use hyper::upgrade::Upgraded;
use hyper_util::rt::TokioIo;
use tokio::net::TcpStream;
use tokio::sync::OwnedSemaphorePermit;
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;

use super::auth::{Grant, Role};
use super::fault::Fault;
use super::refusal::{Answered, Refusal};
use super::socket::Socket;
use super::{Server, connection, convert, metrics, push, twins, uploads};

/// The routes of a server.
pub(super) fn router(server: Arc<Server>) -> Router {
    let json = DefaultBodyLimit::max(wildcity_protocol::limits::INBOUND_MESSAGE_BYTES);
    Router::new()
        .route("/v1/session", get(session))
        .route("/v1/sessions", get(sessions))
        .route("/v1/twins", get(twins::list))
        .route("/v1/twins/{twin}", get(twins::look))
        .route("/v1/twins/{twin}/versions", get(twins::versions))
        .route("/v1/twins/{twin}/rollback", post(twins::rollback))
        .route("/v1/twins/{twin}/pushes", post(push::begin))
        .route("/v1/twins/{twin}/pushes/{id}", get(push::look))
        .route("/v1/uploads", post(uploads::begin))
        // An upload is no message: it goes to disk as it comes.
        .route(
            "/v1/uploads/{id}",
            get(uploads::look)
                .delete(uploads::forget)
                .patch(uploads::append)
                .layer(DefaultBodyLimit::disable()),
        )
        .route("/metrics", get(metrics::show))
        // What is above needs a token where there are any; what follows, none.
        .route_layer(from_fn_with_state(server.clone(), admit))
        .route("/healthz", get(async || "ok\n"))
        .route("/readyz", get(ready))
        .layer(json)
        .layer(from_fn_with_state(server.clone(), metrics::count))
        .with_state(server)
}

/// Lets in who may come in, and tells the routes who it is.
async fn admit(
    State(server): State<Arc<Server>>,
    mut request: Request,
    next: Next,
) -> Result<Response, Refusal> {
    check_origin(request.headers())?;
    let grant = match &server.tokens {
        Some(tokens) => {
            let authorization = request.headers().get(header::AUTHORIZATION);
            tokens.grant(authorization.map(|value| value.as_bytes()))?
        }
        None => Grant::everything(),
    };
    request.extensions_mut().insert(grant);
    Ok(next.run(request).await)
}

/// Browsers send Origin and cannot leave it out where it matters; agents do not. Any page may try to
/// reach 127.0.0.1, so only pages that come from there are let in.
fn check_origin(headers: &HeaderMap) -> Result<(), Fault> {
    match headers.get(header::ORIGIN) {
        Some(origin) if !origin.to_str().is_ok_and(is_local) => {
            let reason = format!("pages from {origin:?} may not come in; loopback origins may");
            Err(Fault::Forbidden { reason })
        }
        _ => Ok(()),
    }
}

/// Whether sessions can be opened: the twins can be listed.
async fn ready(State(server): State<Arc<Server>>) -> Response {
    match server.engine.check_twins().await {
        Ok(()) => "ready\n".into_response(),
        Err(error) => {
            let body = Json(convert::refusal_body(&error.into()));
            (StatusCode::SERVICE_UNAVAILABLE, body).into_response()
        }
    }
}

/// `GET /v1/sessions`: what every session sees.
async fn sessions(
    State(server): State<Arc<Server>>,
    Extension(grant): Extension<Arc<Grant>>,
) -> Answered {
    grant.may(Role::Admin)?;
    let mut sessions = server.sessions.list();
    sessions.retain(|(_, about, _)| grant.sees(&about.twin));
    Ok(Json(convert::sessions(&sessions)).into_response())
}

/// `GET /v1/session`: checks the handshake (RFC 6455, section 4.2) and hands the socket over.
async fn session(
    State(server): State<Arc<Server>>,
    Extension(place): Extension<Arc<OwnedSemaphorePermit>>,
    Extension(grant): Extension<Arc<Grant>>,
    mut request: Request,
) -> Answered {
    let accept = match check(request.headers()) {
        Ok(key) => derive_accept_key(key),
        Err((status, message)) => return Ok((status, format!("{message}\n")).into_response()),
    };
    grant.may(Role::Drive)?;
    let Ok(agent) = server.agents.clone().try_acquire_owned() else {
        let limit = server.limits.connections;
        return Err(Fault::Busy { what: "connections", limit }.into());
    };
    let upgrade = hyper::upgrade::on(&mut request);
    tokio::spawn(async move {
        // Both are held until the connection ends.
        let _held = (place, agent);
        match upgrade.await.map(into_tcp) {
            Ok(Ok((stream, read_ahead))) => {
                let socket = Socket::new(stream, read_ahead, server.limits.send).await;
                connection::serve(server, socket, grant).await;
            }
            Ok(Err(_)) => tracing::error!("a WebSocket upgrade did not give back its socket"),
            Err(error) => tracing::debug!("a client left during its upgrade: {error}"),
        }
    });
    let headers = [
        (header::CONNECTION, "Upgrade"),
        (header::UPGRADE, "websocket"),
        (header::SEC_WEBSOCKET_ACCEPT, &accept),
        (header::SEC_WEBSOCKET_PROTOCOL, convert::SUBPROTOCOL),
    ];
    Ok((StatusCode::SWITCHING_PROTOCOLS, headers).into_response())
}

/// The socket under an upgraded connection, and what was read from it already.
fn into_tcp(upgraded: Upgraded) -> Result<(TcpStream, Vec<u8>), Upgraded> {
    let parts = upgraded.downcast::<TokioIo<TcpStream>>()?;
    Ok((parts.io.into_inner(), parts.read_buf.into()))
}

/// The client's key, if it may come in.
fn check(headers: &HeaderMap) -> Result<&[u8], (StatusCode, String)> {
    let any = |name: header::HeaderName, is_wanted: &dyn Fn(&str) -> bool| {
        let values = headers.get_all(name).into_iter().filter_map(|value| value.to_str().ok());
        values.flat_map(|value| value.split(',')).any(|value| is_wanted(value.trim()))
    };
    let has = |name, wanted: &str| any(name, &|value| value.eq_ignore_ascii_case(wanted));
    let bad = |message: &str| Err((StatusCode::BAD_REQUEST, message.to_owned()));
    if !has(header::CONNECTION, "upgrade") || !has(header::UPGRADE, "websocket") {
        let message = "this address speaks WebSocket: send an upgrade".to_owned();
        return Err((StatusCode::UPGRADE_REQUIRED, message));
    }
    if !has(header::SEC_WEBSOCKET_VERSION, "13") {
        return bad("Sec-WebSocket-Version must be 13");
    }
    // Unlike the tokens above, names of subprotocols have a case.
    if !any(header::SEC_WEBSOCKET_PROTOCOL, &|offered| offered == convert::SUBPROTOCOL) {
        return bad("offer the subprotocol wildcity.v1 in Sec-WebSocket-Protocol");
    }
    match headers.get(header::SEC_WEBSOCKET_KEY) {
        Some(key) if is_key(key.as_bytes()) => Ok(key.as_bytes()),
        _ => bad("Sec-WebSocket-Key must be 16 bytes in base64"),
    }
}

/// Whether a text is base64 of 16 bytes: 22 digits, and padding.
fn is_key(text: &[u8]) -> bool {
    let is_digit = |b: &u8| b.is_ascii_alphanumeric() || b"+/".contains(b);
    matches!(text.strip_suffix(b"=="), Some(digits) if digits.len() == 22 && digits.iter().all(is_digit))
}

/// Whether an origin is a page served from this machine.
fn is_local(origin: &str) -> bool {
    let Some((_, authority)) = origin.split_once("://") else { return false };
    let host = match authority.rsplit_once(':') {
        Some((host, port)) if port.bytes().all(|b| b.is_ascii_digit()) => host,
        _ => authority,
    };
    ["localhost", "127.0.0.1", "[::1]"].contains(&host)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn local_origins() {
        for origin in
            ["http://localhost", "http://127.0.0.1:8080", "https://[::1]:1", "http://[::1]"]
        {
            assert!(is_local(origin), "{origin}");
        }
        for origin in [
            "null",
            "http://example.org",
            "http://localhost.example.org",
            "http://127.0.0.1.example.org:80",
            "http://example.org:127",
            "http://user@example.org",
            "http://localhost:80@example.org",
        ] {
            assert!(!is_local(origin), "{origin}");
        }
    }
}
