//! Faults as HTTP answers.

use axum::Json;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};

use crate::fault::Fault;

/// The result of a route.
pub(crate) type HttpResult = Result<Response, Refusal>;

/// A fault that becomes an HTTP answer.
#[derive(Debug)]
pub(crate) struct Refusal(Box<Fault>);

impl<F: Into<Fault>> From<F> for Refusal {
    fn from(fault: F) -> Self {
        Self(Box::new(fault.into()))
    }
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        // Debug and not a warning: a client can cause any number of refusals.
        let report = self.0.report();
        let status = report.status;
        tracing::debug!(%status, "refused: {}", report.body.message);
        let mut response = (status, Json(report.json())).into_response();
        if status == StatusCode::UNAUTHORIZED {
            let bearer = HeaderValue::from_static("Bearer realm=\"wildcity\"");
            response.headers_mut().insert(header::WWW_AUTHENTICATE, bearer);
        }
        // A client whose handshake is refused gets the supported versions (RFC 6455, section 4.4).
        if matches!(*self.0, Fault::NoUpgrade | Fault::Handshake { .. }) {
            let headers = response.headers_mut();
            headers.insert(header::UPGRADE, HeaderValue::from_static("websocket"));
            headers.insert(header::SEC_WEBSOCKET_VERSION, HeaderValue::from_static("13"));
        }
        // The middleware that counts refusals reads the code here, not in the body.
        response.extensions_mut().insert(report.code());
        response
    }
}
