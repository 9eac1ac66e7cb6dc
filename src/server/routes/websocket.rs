//! The upgrade from HTTP to WebSocket.

use std::sync::Arc;

use axum::Extension;
use axum::extract::{Path, Request, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::IntoResponse as _;
use hyper::upgrade::Upgraded;
use hyper_util::rt::TokioIo;
use tokio::sync::OwnedSemaphorePermit;
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;

use crate::admission::ConnectionSlot;
use crate::auth::Grant;
use crate::connection;
use crate::convert;
use crate::fault::Fault;
use crate::socket::Socket;
use crate::state::ServerState;
use crate::stream::Stream;
use crate::token_counts::Counted;
use crate::unfinished::OwnUnfinished;
use crate::watchers;

use super::refusal::HttpResult;

/// The route of sessions.
pub(super) const SESSION: &str = "/v1/session";
/// The route of watchers.
pub(super) const WATCH: &str = "/v1/sessions/{session}/watch";

/// `GET /v1/session`: checks the handshake (RFC 6455, section 4.2) and hands the socket over to a
/// [`connection`].
pub(super) async fn upgrade(
    State(state): State<Arc<ServerState>>,
    Extension(slot): Extension<Arc<ConnectionSlot>>,
    Extension(grant): Extension<Arc<Grant>>,
    request: Request,
) -> HttpResult {
    // The handshake is checked before any counter is taken.
    let accept = accept(request.headers(), convert::SUBPROTOCOL)?;
    let shared = state.clone();
    let is_forwarded = is_forwarded(request.headers());
    let slots = Slots::take(&state, slot, &grant)?;
    hand_over(&state, slots, accept, convert::SUBPROTOCOL, request, async move |socket| {
        connection::serve(shared, socket, grant, is_forwarded).await;
    })
}

/// `GET /v1/sessions/{session}/watch`: checks the handshake, and hands the socket over to a
/// [`watchers`]' end of the session.
pub(super) async fn watch(
    State(state): State<Arc<ServerState>>,
    Extension(slot): Extension<Arc<ConnectionSlot>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(session): Path<String>,
    request: Request,
) -> HttpResult {
    let accept = accept(request.headers(), convert::WATCH_SUBPROTOCOL)?;
    // Found before the upgrade, so that an unknown session is an HTTP answer and not a Close frame.
    let watch = state.sessions.watch(&session, &grant)?;
    let shared = state.clone();
    let slots = Slots::take(&state, slot, &grant)?;
    hand_over(&state, slots, accept, convert::WATCH_SUBPROTOCOL, request, async move |socket| {
        watchers::serve(shared.stopped(), socket, watch).await;
    })
}

/// The subprotocol of a route, if the route is a WebSocket.
pub(super) fn subprotocol(route: &str) -> Option<&'static str> {
    match route {
        SESSION => Some(convert::SUBPROTOCOL),
        WATCH => Some(convert::WATCH_SUBPROTOCOL),
        _ => None,
    }
}

/// Counters that include a WebSocket connection until it is dropped.
struct Slots {
    /// The name of the client's token.
    token: String,
    _connection: Arc<ConnectionSlot>,
    _of_server: OwnedSemaphorePermit,
    _of_token: Counted,
}

impl Slots {
    /// # Errors
    /// [`Fault::Busy`]: the server or the token has as many WebSocket connections as it may.
    fn take(
        state: &ServerState,
        connection: Arc<ConnectionSlot>,
        grant: &Grant,
    ) -> Result<Self, Fault> {
        // The token's own limit first, so that its error is the one that is named.
        let of_token = state.open_connections.connection(grant, state.limits.connections)?;
        let limit = state.limits.connections;
        let of_server = state
            .websocket_permits
            .clone()
            .try_acquire_owned()
            .map_err(|_| Fault::Busy { what: "connections", limit })?;
        Ok(Self {
            token: grant.name.clone(),
            _connection: connection,
            _of_server: of_server,
            _of_token: of_token,
        })
    }
}

/// Answers a handshake, and serves its socket once that is upgraded.
fn hand_over<F>(
    state: &Arc<ServerState>,
    slots: Slots,
    accept: String,
    protocol: &'static str,
    mut request: Request,
    serve: impl FnOnce(Socket) -> F + Send + 'static,
) -> HttpResult
where
    F: Future<Output = ()> + Send,
{
    // This completes after the answer below was sent, so it is awaited in another task.
    let upgrade = hyper::upgrade::on(&mut request);
    let send_timeout = state.limits.send;
    let unfinished = OwnUnfinished::new(state.unfinished.clone(), slots.token.clone());
    state.engine.polls().spawn("WebSocket", async move {
        // Held until the connection ends.
        let _slots = slots;
        match upgrade.await.map(into_stream) {
            Ok(Ok((stream, read_ahead))) => {
                serve(Socket::new(stream, read_ahead, send_timeout, unfinished).await).await;
            }
            Ok(Err(_)) => tracing::error!("a WebSocket upgrade did not give back its socket"),
            Err(error) => tracing::debug!("a client left during its upgrade: {error}"),
        }
    });
    let headers = [
        (header::CONNECTION, "Upgrade"),
        (header::UPGRADE, "websocket"),
        (header::SEC_WEBSOCKET_ACCEPT, &accept),
        (header::SEC_WEBSOCKET_PROTOCOL, protocol),
    ];
    Ok((StatusCode::SWITCHING_PROTOCOLS, headers).into_response())
}

/// The answer to the client's key, if the headers are those of a WebSocket handshake.
fn accept(headers: &HeaderMap, protocol: &'static str) -> Result<String, Fault> {
    check_handshake(headers, protocol).map(derive_accept_key)
}

/// The socket under an upgraded connection, and the bytes that were already read from it.
fn into_stream(upgraded: Upgraded) -> Result<(Stream, Vec<u8>), Upgraded> {
    let parts = upgraded.downcast::<TokioIo<Stream>>()?;
    Ok((parts.io.into_inner(), parts.read_buf.into()))
}

/// The client's key, if the headers are those of a WebSocket handshake.
pub(super) fn check_handshake<'a>(
    headers: &'a HeaderMap,
    protocol: &'static str,
) -> Result<&'a [u8], Fault> {
    // Each header may occur several times, and each value may be a list: `Connection: keep-alive,
    // Upgrade`.
    let any = |name: header::HeaderName, is_wanted: &dyn Fn(&str) -> bool| {
        let values = headers.get_all(name).into_iter().filter_map(|value| value.to_str().ok());
        values.flat_map(|value| value.split(',')).any(|value| is_wanted(value.trim()))
    };
    let has = |name, wanted: &str| any(name, &|value| value.eq_ignore_ascii_case(wanted));
    if !has(header::CONNECTION, "upgrade") || !has(header::UPGRADE, "websocket") {
        return Err(Fault::NoUpgrade);
    }
    if !has(header::SEC_WEBSOCKET_VERSION, "13") {
        return Err(Fault::Handshake { header: "sec-websocket-version", must: "must be 13" });
    }
    // Unlike the values above, names of subprotocols are case-sensitive.
    if !any(header::SEC_WEBSOCKET_PROTOCOL, &|offered| offered == protocol) {
        return Err(Fault::NoSubprotocol { protocol });
    }
    match headers.get(header::SEC_WEBSOCKET_KEY) {
        Some(key) if is_key(key.as_bytes()) => Ok(key.as_bytes()),
        _ => {
            let must = "must be 16 bytes in base64";
            Err(Fault::Handshake { header: "sec-websocket-key", must })
        }
    }
}

/// Whether the headers show that the request came through a proxy.
fn is_forwarded(headers: &HeaderMap) -> bool {
    // A proxy that sends none of these is not noticed; the proof of the shared memory then fails,
    // as the client cannot open it.
    ["forwarded", "x-forwarded-for", "x-real-ip", "via"]
        .iter()
        .any(|name| headers.contains_key(*name))
}

/// Whether a text is base64 of 16 bytes: 22 digits, and padding.
fn is_key(text: &[u8]) -> bool {
    // 16 bytes are 128 bits, which take 22 digits of 6 bits, and 2 characters of padding.
    let is_digit = |b: &u8| b.is_ascii_alphanumeric() || b"+/".contains(b);
    matches!(text.strip_suffix(b"=="), Some(digits) if digits.len() == 22 && digits.iter().all(is_digit))
}
