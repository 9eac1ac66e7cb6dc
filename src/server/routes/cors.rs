//! Answers to pages of other sites (the Fetch standard, section 3.2: CORS): those of this machine
//! and of `--origin`.

use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::{HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};

use crate::origins::is_local_origin;
use crate::state::ServerState;

/// How long a browser caches the permissions of a page, in seconds.
const MAX_AGE_S: &str = "600";
const METHODS: &str = "GET, POST, PATCH, DELETE";
const REQUEST_HEADERS: &str = "authorization, content-type, upload-offset, content-digest";
const ANSWER_HEADERS: &str = "upload-offset";

/// Lets local and listed pages read answers, and answers a browser's preflight requests for them.
pub(super) async fn answer(
    State(state): State<Arc<ServerState>>,
    request: Request,
    next: Next,
) -> Response {
    let origin = request.headers().get(header::ORIGIN).cloned();
    let is_served = |origin: &HeaderValue| {
        state.origins.lists(origin.as_bytes()) || origin.to_str().is_ok_and(is_local_origin)
    };
    // No header is the refusal: the browser then keeps the answer from the page.
    let Some(origin) = origin.filter(is_served) else {
        return next.run(request).await;
    };
    // A preflight has no token, so that it must be answered before `authorize`.
    let is_preflight = request.method() == Method::OPTIONS
        && request.headers().contains_key(header::ACCESS_CONTROL_REQUEST_METHOD);
    let mut response =
        if is_preflight { StatusCode::NO_CONTENT.into_response() } else { next.run(request).await };
    let headers = response.headers_mut();
    headers.insert(header::ACCESS_CONTROL_ALLOW_ORIGIN, origin);
    // The answer names one origin, so a cache must not give it to another one.
    headers.append(header::VARY, HeaderValue::from_static("origin"));
    let mut say = |name, value| headers.insert(name, HeaderValue::from_static(value));
    if is_preflight {
        say(header::ACCESS_CONTROL_ALLOW_METHODS, METHODS);
        say(header::ACCESS_CONTROL_ALLOW_HEADERS, REQUEST_HEADERS);
        say(header::ACCESS_CONTROL_MAX_AGE, MAX_AGE_S);
    } else {
        say(header::ACCESS_CONTROL_EXPOSE_HEADERS, ANSWER_HEADERS);
    }
    response
}
