//! Faults as answers of HTTP.

use axum::Json;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};

use wildcity_session::SessionError;
use wildcity_twin::residency::ResidencyError;
use wildcity_twin::store::StoreError;

use super::convert;
use super::fault::Fault;

/// What a route answers.
pub(super) type Answered = Result<Response, Refusal>;

/// A fault on its way out.
#[derive(Debug)]
pub(super) struct Refusal(Fault);

impl<F: Into<Fault>> From<F> for Refusal {
    fn from(fault: F) -> Self {
        Self(fault.into())
    }
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        let status = status(&self.0);
        tracing::debug!(%status, "refused: {}", self.0);
        let mut response = (status, Json(convert::refusal_body(&self.0))).into_response();
        if status == StatusCode::UNAUTHORIZED {
            let bearer = HeaderValue::from_static("Bearer realm=\"wildcity\"");
            response.headers_mut().insert(header::WWW_AUTHENTICATE, bearer);
        }
        // Whoever counts refusals need not read bodies.
        response.extensions_mut().insert(convert::code(&self.0));
        response
    }
}

fn status(fault: &Fault) -> StatusCode {
    match fault {
        Fault::MalformedJson(_)
        | Fault::InvalidRequest { .. }
        | Fault::InvalidName { .. }
        | Fault::OutOfRange { .. }
        | Fault::Pose { .. }
        | Fault::NotFinite { .. } => StatusCode::BAD_REQUEST,
        Fault::MessageTooLarge { .. } => StatusCode::PAYLOAD_TOO_LARGE,
        Fault::Unauthorized => StatusCode::UNAUTHORIZED,
        Fault::Forbidden { .. } => StatusCode::FORBIDDEN,
        Fault::UnknownUpload { .. } | Fault::UnknownPush { .. } => StatusCode::NOT_FOUND,
        Fault::UploadOffset { .. } | Fault::Replaced => StatusCode::CONFLICT,
        Fault::UploadDigest { .. } | Fault::Content { .. } => StatusCode::UNPROCESSABLE_ENTITY,
        Fault::StorageFull { .. } => StatusCode::INSUFFICIENT_STORAGE,
        Fault::TimedOut(_) => StatusCode::REQUEST_TIMEOUT,
        Fault::Busy { .. } | Fault::ShuttingDown | Fault::NoUploads { .. } => {
            StatusCode::SERVICE_UNAVAILABLE
        }
        Fault::Session(error) => of_session(error),
        _ => StatusCode::INTERNAL_SERVER_ERROR,
    }
}

fn of_session(error: &SessionError) -> StatusCode {
    match error {
        SessionError::Twin(StoreError::Name { .. }) => StatusCode::BAD_REQUEST,
        SessionError::Twin(StoreError::NoTwin { .. } | StoreError::NoVersion { .. }) => {
            StatusCode::NOT_FOUND
        }
        SessionError::Twin(StoreError::Overlap { .. } | StoreError::Conflict { .. }) => {
            StatusCode::CONFLICT
        }
        SessionError::Residency(ResidencyError::NoRoom { .. }) | SessionError::Busy { .. } => {
            StatusCode::SERVICE_UNAVAILABLE
        }
        _ => StatusCode::INTERNAL_SERVER_ERROR,
    }
}
