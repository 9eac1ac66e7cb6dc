//! HTTP routes.

mod episodes;
mod metrics;
mod pushes;
mod refusal;
mod sessions;
mod twins;
mod uploads;
mod websocket;

use std::sync::Arc;

use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::{HeaderMap, Method, StatusCode, Uri, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse as _, Response};
use axum::routing::{get, post};
use axum::{Json, Router};

use crate::auth::Grant;
use crate::convert;
use crate::fault::Fault;
use crate::newcomers::ConnectionSlot;
use crate::state::ServerState;

use refusal::Refusal;

/// The routes of a server.
pub(crate) fn router(state: Arc<ServerState>) -> Router {
    let json_limit = DefaultBodyLimit::max(wildcity_protocol::limits::INBOUND_MESSAGE_BYTES);
    Router::new()
        .route("/v1/session", get(websocket::upgrade))
        .route("/v1/sessions", get(sessions::list))
        .route("/v1/episodes", get(episodes::list))
        .route("/v1/episodes/{episode}", get(episodes::show))
        .route("/v1/twins", get(twins::list))
        .route("/v1/twins/{twin}", get(twins::show))
        .route("/v1/twins/{twin}/versions", get(twins::versions))
        .route("/v1/twins/{twin}/trajectories/{name}", get(twins::trajectory))
        .route("/v1/twins/{twin}/rollback", post(twins::rollback))
        .route("/v1/twins/{twin}/pushes", post(pushes::begin))
        .route("/v1/twins/{twin}/pushes/{id}", get(pushes::show).delete(pushes::cancel))
        .route("/v1/uploads", post(uploads::begin))
        // The body of an upload is not held in memory: it is written to disk as it arrives.
        .route(
            "/v1/uploads/{id}",
            get(uploads::show)
                .delete(uploads::delete)
                .patch(uploads::append)
                .layer(DefaultBodyLimit::disable()),
        )
        .route("/metrics", get(metrics::show))
        // The routes above need a token on a server with tokens; those below need none.
        .route_layer(from_fn_with_state(state.clone(), authorize))
        .route("/healthz", get(async || "ok\n"))
        .route("/readyz", get(ready))
        .fallback(no_route)
        .method_not_allowed_fallback(no_method)
        .layer(json_limit)
        .layer(from_fn_with_state(state.clone(), metrics::count_refusals))
        .with_state(state)
}

/// Refuses requests without a valid token, and passes the token's [`Grant`] to the routes.
async fn authorize(
    State(state): State<Arc<ServerState>>,
    mut request: Request,
    next: Next,
) -> Result<Response, Refusal> {
    check_origin(request.headers())?;
    let grant = match &state.tokens {
        Some(tokens) => {
            let authorization = request.headers().get(header::AUTHORIZATION);
            tokens.grant(authorization.map(|value| value.as_bytes()))?
        }
        None => {
            check_host(&request)?;
            Grant::everything()
        }
    };
    if let Some(slot) = request.extensions().get::<Arc<ConnectionSlot>>() {
        slot.become_known()?;
    }
    request.extensions_mut().insert(grant);
    Ok(next.run(request).await)
}

/// Refuses requests from web pages of other hosts, because a page of any site can send requests to
/// 127.0.0.1. Browsers always send `Origin` with such requests; agents do not send it.
fn check_origin(headers: &HeaderMap) -> Result<(), Fault> {
    match headers.get(header::ORIGIN) {
        Some(origin) if !origin.to_str().is_ok_and(is_local) => {
            let origin = String::from_utf8_lossy(origin.as_bytes()).into_owned();
            Err(Fault::ForbiddenOrigin { origin })
        }
        _ => Ok(()),
    }
}

/// Refuses requests for other hosts, on a server without tokens. A web page can let the name of its own host stand
/// for 127.0.0.1 (DNS rebinding); then its requests have no foreign `Origin`, but still that name as the host.
fn check_host(request: &Request) -> Result<(), Fault> {
    let header = request.headers().get(header::HOST).map(|host| host.to_str().unwrap_or_default());
    let host = request.uri().authority().map(|authority| authority.as_str()).or(header);
    match host {
        Some(host) if !is_local_authority(host) => {
            let reason = format!(
                "requests for host {host:?} are refused; without tokens, localhost is served"
            );
            Err(Fault::Forbidden { field: "host", reason })
        }
        _ => Ok(()),
    }
}

/// `GET /readyz`: whether sessions can be opened, which needs the list of twins.
async fn ready(State(state): State<Arc<ServerState>>) -> Response {
    match state.engine.check_twins().await {
        Ok(()) => "ready\n".into_response(),
        Err(error) => {
            let body = Json(convert::refusal_body(&error.into()));
            (StatusCode::SERVICE_UNAVAILABLE, body).into_response()
        }
    }
}

async fn no_route(uri: Uri) -> Refusal {
    Fault::NoRoute { path: uri.path().to_owned() }.into()
}

async fn no_method(method: Method, uri: Uri) -> Refusal {
    Fault::NoMethod { method: method.to_string(), path: uri.path().to_owned() }.into()
}

/// Whether an origin is a page served from this machine.
fn is_local(origin: &str) -> bool {
    origin.split_once("://").is_some_and(|(_, authority)| is_local_authority(authority))
}

/// Whether a host, with or without a port, is this machine.
fn is_local_authority(authority: &str) -> bool {
    let host = match authority.rsplit_once(':') {
        Some((host, port)) if port.bytes().all(|b| b.is_ascii_digit()) => host,
        _ => authority,
    };
    host.eq_ignore_ascii_case("localhost") || ["127.0.0.1", "[::1]"].contains(&host)
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
