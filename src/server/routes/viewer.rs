//! The viewer: the page at `/` and its files, which are part of the program. Script and style are
//! built from `clients/viewer/src`; the other files are in that folder.

use axum::http::{HeaderName, header};
use axum::response::IntoResponse;

/// A file of the viewer.
#[derive(Clone, Copy)]
pub(super) struct File {
    pub(super) path: &'static str,
    content_type: &'static str,
    bytes: &'static [u8],
}

/// All files of the viewer.
pub(super) const FILES: [File; 4] = [
    File {
        path: "/",
        content_type: "text/html; charset=utf-8",
        bytes: include_bytes!("../../../clients/viewer/src/index.html"),
    },
    File {
        path: "/viewer.js",
        content_type: "text/javascript; charset=utf-8",
        bytes: include_bytes!("../../../clients/viewer/dist/viewer.js"),
    },
    File {
        path: "/style.css",
        content_type: "text/css; charset=utf-8",
        bytes: include_bytes!("../../../clients/viewer/dist/style.css"),
    },
    File {
        path: "/icon.svg",
        content_type: "image/svg+xml",
        bytes: include_bytes!("../../../clients/viewer/src/icon.svg"),
    },
];

/// The page may load from and connect to only this server; no other page may show it in a frame.
/// Images arrive over the WebSocket, and are decoded from memory.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; \
     base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

impl File {
    /// The content type without its parameters.
    pub(super) fn media_type(self) -> &'static str {
        self.content_type.split_once(';').map_or(self.content_type, |(media_type, _)| media_type)
    }

    /// The answer to a request for the file.
    pub(super) fn response(self) -> impl IntoResponse {
        let headers: [(HeaderName, &'static str); 5] = [
            (header::CONTENT_TYPE, self.content_type),
            (header::CONTENT_SECURITY_POLICY, POLICY),
            // Browsers must not guess another type, nor tell other sites the address of the page.
            (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
            (header::REFERRER_POLICY, "no-referrer"),
            // The files change with the program only, but their names stay.
            (header::CACHE_CONTROL, "no-cache"),
        ];
        (headers, self.bytes)
    }
}
