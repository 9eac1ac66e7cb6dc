//! Every route, with the tokens that may use it and its description for `/v1/openapi.json`. The
//! router is made from this table, so that no route lacks a check of tokens, or is missing in the
//! document.

use std::sync::Arc;

use axum::extract::DefaultBodyLimit;
use axum::handler::Handler;
use axum::routing::{MethodFilter, MethodRouter, on};

use crate::auth::{Access, Role};
use crate::state::ServerState;

use super::{
    actors, episodes, metrics, openapi, pushes, ready, scenarios, sessions, tickets, twins,
    uploads, viewer, websocket,
};

/// A method of a path.
#[derive(Clone, Copy)]
#[cfg_attr(
    not(test),
    expect(dead_code, reason = "the test that writes the document reads the rest")
)]
pub(super) struct Operation {
    pub(super) method: Method,
    /// As axum and OpenAPI write it: `/v1/twins/{twin}`.
    pub(super) path: &'static str,
    pub(super) access: Access,
    /// Description of the route.
    pub(super) summary: &'static str,
    /// Status of success, and what is sent then.
    pub(super) success: u16,
    pub(super) answer: Content,
    /// Other answers to requests that the document describes.
    pub(super) others: &'static [Other],
    pub(super) body: Content,
    /// Parameters in addition to those of the path.
    pub(super) parameters: &'static [Parameter],
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Method {
    Get,
    Head,
    Post,
    Patch,
    Delete,
}

/// A status in addition to that of success. Below 300 the body is the same as for success,
/// otherwise it is a refusal.
pub(super) type Other = (u16, &'static str);

/// Kind of a body.
#[derive(Clone, Copy)]
#[cfg_attr(
    not(test),
    expect(dead_code, reason = "the test that writes the document reads the rest")
)]
pub(super) enum Content {
    None,
    /// The schema of this name in `protocol/schema`.
    Json(&'static str),
    /// An object with a list of a schema's values under a name.
    List(&'static str, &'static str),
    /// An object without a schema of its own.
    Object,
    /// Anything else, by its media type.
    Media(&'static str),
}

/// Kind of a parameter.
#[derive(Clone, Copy)]
pub(super) enum Kind {
    /// An integer from 0.
    Count,
    Number,
    /// A number above 0.
    Length,
    Text,
}

/// A parameter of the query or a header.
#[derive(Clone, Copy)]
#[cfg_attr(
    not(test),
    expect(dead_code, reason = "the test that writes the document reads the rest")
)]
pub(super) struct Parameter {
    pub(super) name: &'static str,
    /// Where the parameter is: `query` or `header`.
    pub(super) place: &'static str,
    pub(super) kind: Kind,
    pub(super) is_required: bool,
    pub(super) description: &'static str,
}

/// A route: its description, and its handler.
pub(super) struct Row {
    pub(super) operation: Operation,
    pub(super) handler: MethodRouter<Arc<ServerState>>,
}

impl Operation {
    const fn new(
        method: Method,
        path: &'static str,
        access: Access,
        summary: &'static str,
    ) -> Self {
        Self {
            method,
            path,
            access,
            summary,
            success: 200,
            answer: Content::None,
            others: &[],
            body: Content::None,
            parameters: &[],
        }
    }

    const fn answers(self, success: u16, answer: Content) -> Self {
        Self { success, answer, ..self }
    }

    const fn or(self, others: &'static [Other]) -> Self {
        Self { others, ..self }
    }

    const fn takes(self, body: Content) -> Self {
        Self { body, ..self }
    }

    const fn with(self, parameters: &'static [Parameter]) -> Self {
        Self { parameters, ..self }
    }

    fn does<H: Handler<T, Arc<ServerState>>, T: 'static>(self, handler: H) -> Row {
        let method = match self.method {
            Method::Get => MethodFilter::GET,
            Method::Head => MethodFilter::HEAD,
            Method::Post => MethodFilter::POST,
            Method::Patch => MethodFilter::PATCH,
            Method::Delete => MethodFilter::DELETE,
        };
        Row { operation: self, handler: on(method, handler) }
    }
}

impl Row {
    /// Accepts a body of any length. This layer is nearer to the handler than that of the router,
    /// and so it wins.
    fn without_body_limit(self) -> Self {
        Self { handler: self.handler.layer(DefaultBodyLimit::disable()), ..self }
    }
}

const TICKET: Parameter = Parameter {
    name: "ticket",
    place: "query",
    kind: Kind::Text,
    is_required: false,
    description: "A ticket instead of the header Authorization.",
};

const fn query(name: &'static str, kind: Kind, description: &'static str) -> Parameter {
    Parameter { name, place: "query", kind, is_required: false, description }
}

const DRIVE_PARAMETERS: &[Parameter] = &[
    query("version", Kind::Count, "Version of the twin; the latest if absent."),
    query("from_m", Kind::Number, "Station of the first pose, in metres."),
    query("to_m", Kind::Number, "Station of the last pose, in metres."),
    query(
        "every_m",
        Kind::Length,
        "Distance between two poses, in metres; the recorded keyframes if absent.",
    ),
];

const UPLOAD_PARAMETERS: &[Parameter] = &[
    Parameter {
        name: "Upload-Offset",
        place: "header",
        kind: Kind::Count,
        is_required: true,
        description: "Where the bytes of the body begin in the file.",
    },
    Parameter {
        name: "Content-Digest",
        place: "header",
        kind: Kind::Text,
        is_required: false,
        description: "Digest of the body, as RFC 9530 says.",
    },
];

const NO_HANDSHAKE: Other = (426, "The request is no handshake of a WebSocket.");
const NONE: Other = (404, "There is none.");
const FULL: Other = (507, "There is no room for it.");

const METRICS: Access = Access::Role(Role::Metrics);
const DRIVE: Access = Access::Role(Role::Drive);
const PUSH: Access = Access::Role(Role::Push);
const ADMIN: Access = Access::Role(Role::Admin);

const TEXT: Content = Content::Media("text/plain");

/// The routes of a server.
pub(super) fn rows() -> Vec<Row> {
    use Access::{AnyToken, Public};
    use Content::{Json, List, Media};
    use Method::{Delete, Get, Head, Patch, Post};
    let op = Operation::new;
    // Each row is both the route and its documentation, so that neither can be forgotten.
    let mut rows = vec![
        op(
            Get,
            websocket::SESSION,
            DRIVE,
            "Upgrade to the WebSocket of a session (subprotocol wildcity.v1).",
        )
        .answers(101, Content::None)
        .or(&[NO_HANDSHAKE])
        .with(&[TICKET])
        .does(websocket::upgrade),
        op(Get, "/v1/sessions", ADMIN, "All sessions.")
            .answers(200, List("sessions", "session"))
            .does(sessions::list),
        op(
            Get,
            websocket::WATCH,
            DRIVE,
            "Upgrade to a WebSocket with a session's observations.",
        )
        .answers(101, Content::None)
        .or(&[NO_HANDSHAKE, NONE])
        .with(&[TICKET])
        .does(websocket::watch),
        op(
            Post,
            "/v1/tickets",
            AnyToken,
            "A ticket, which stands for the token in the address of one WebSocket.",
        )
        .answers(201, Json("ticket"))
        .does(tickets::issue),
        op(Get, "/v1/episodes", ADMIN, "The newest recorded episodes, the newest first.")
            .answers(200, List("episodes", "episode"))
            .does(episodes::list),
        op(Get, "/v1/episodes/{episode}", ADMIN, "The record of an episode, a JSON object a line.")
            .answers(200, Media("application/x-ndjson"))
            .or(&[NONE])
            .does(episodes::show),
        op(Get, "/v1/episodes/{episode}/mcap", ADMIN, "An episode that ended as MCAP.")
            .answers(200, Media("application/vnd.mcap"))
            .or(&[NONE])
            .does(episodes::mcap),
        op(Get, "/v1/twins", AnyToken, "The latest version of every twin, and the damaged twins.")
            .answers(200, Json("twins"))
            .does(twins::list),
        op(Get, "/v1/twins/{twin}", AnyToken, "The latest version of a twin.")
            .answers(200, Json("answer#TwinInfo"))
            .or(&[NONE])
            .does(twins::show),
        op(Get, "/v1/twins/{twin}/versions", AnyToken, "All versions of a twin, the latest last.")
            .answers(200, List("versions", "version"))
            .or(&[NONE])
            .does(twins::versions),
        op(Get, "/v1/twins/{twin}/trajectories/{name}", AnyToken, "Poses of a recorded drive.")
            .answers(200, Json("drive"))
            .or(&[(400, "The stations are not on the drive, or there are too many poses."), NONE])
            .with(DRIVE_PARAMETERS)
            .does(twins::trajectory),
        op(
            Post,
            "/v1/twins/{twin}/rollback",
            ADMIN,
            "Makes an old version the latest, under a new number.",
        )
        .takes(Json("rollback"))
        .answers(200, Json("made_version"))
        .or(&[NONE])
        .does(twins::rollback),
        op(
            Get,
            "/v1/twins/{twin}/ground",
            PUSH,
            "Where a twin is, and the ground it seems to stand on.",
        )
        .answers(200, Json("ground"))
        .or(&[NONE])
        .does(twins::ground),
        op(
            Post,
            "/v1/twins/{twin}/edits",
            PUSH,
            "Makes a version on level ground, in metres, with a drive and a rig.",
        )
        .takes(Json("new_edit"))
        .answers(200, Json("made_version"))
        .or(&[
            (400, "No ground, scale, drive or version can be made of these numbers."),
            (404, "There is no such twin, version or rig."),
            (409, "Others changed the twin meanwhile."),
        ])
        .does(twins::edit),
        op(Post, "/v1/twins/{twin}/pushes", PUSH, "Makes a new version from uploads.")
            .takes(Json("new_push"))
            .answers(202, Json("push"))
            .or(&[
                (400, "The axes of a file are no rotation, or a setting is none of the profile."),
                (404, "There is no such upload or version."),
                (409, "Others changed the same cells since the base."),
            ])
            .does(pushes::begin),
        op(Get, "/v1/twins/{twin}/pushes/{id}", PUSH, "State of a push.")
            .answers(200, Json("push"))
            .or(&[NONE])
            .does(pushes::show),
        op(Delete, "/v1/twins/{twin}/pushes/{id}", PUSH, "Cancels a push.")
            .answers(200, Json("push"))
            .or(&[NONE, (409, "It is too late.")])
            .does(pushes::cancel),
        op(
            Post,
            "/v1/uploads",
            PUSH,
            "Announces a file.",
        )
        .takes(Json("new_upload"))
        .answers(201, Json("upload"))
        .or(&[
            (200, "All of its bytes are there already."),
            (400, "The file is too large, or its name too long in bytes."),
            (422, "A file without bytes has another digest, or the size is not that of the content."),
            FULL,
        ])
        .does(uploads::begin),
        op(Get, "/v1/uploads/{id}", PUSH, "State of an upload.")
            .answers(200, Json("upload"))
            .or(&[NONE])
            .does(uploads::show),
        op(Head, "/v1/uploads/{id}", PUSH, "State of an upload: its header Upload-Offset.")
            .answers(200, Content::None)
            .or(&[NONE])
            .does(uploads::show),
        op(Delete, "/v1/uploads/{id}", PUSH, "Removes an upload.")
            .answers(204, Content::None)
            .or(&[NONE])
            .does(uploads::delete),
        op(
            Get,
            "/v1/scenarios",
            AnyToken,
            "Names of the scenarios that can be opened by name; none for a token of some twins.",
        )
        .answers(200, Content::Object)
        .does(scenarios::list),
        op(
            Get,
            "/v1/twins/{twin}/scenarios",
            AnyToken,
            "The scenarios that play in a twin, and outlines of the lanes of their maps.",
        )
        .answers(200, Content::Object)
        .does(scenarios::in_twin),
        op(Get, "/v1/actors", AnyToken, "All assets of actors, and the damaged ones.")
            .answers(200, Json("actors"))
            .does(actors::list),
        op(
            Get,
            "/v1/actors/{actor}",
            AnyToken,
            "The asset of an actor of this name, or of a hash that begins so.",
        )
        .answers(200, Json("actors#ActorAsset"))
        .or(&[(400, "Several assets have a hash that begins so."), NONE])
        .does(actors::show),
        op(
            Post,
            "/v1/actors",
            PUSH,
            "Makes an asset of an actor from uploads.",
        )
        .takes(Json("new_actor"))
        .answers(201, Json("actors#ActorAsset"))
        .or(&[
            (200, "It is there already."),
            (400, "The axes of a file are no rotation."),
            (404, "There is no such upload."),
            (409, "An asset of another content has the name."),
            (422, "The files cannot be an asset."),
        ])
        .does(actors::push),
        op(Get, metrics::PATH, METRICS, "Metrics for Prometheus.")
            .answers(200, Media("application/openmetrics-text"))
            .does(metrics::show),
        op(
            Patch,
            "/v1/uploads/{id}",
            PUSH,
            "Sends bytes of a file, from the offset that the upload is at.",
        )
        .takes(Media("application/octet-stream"))
        .answers(200, Json("upload"))
        .or(&[
            (400, "Content-Digest is none, or Upload-Offset is missing."),
            NONE,
            (409, "The upload goes on from another offset."),
            (422, "The bytes are not those that were announced."),
            FULL,
        ])
        .with(UPLOAD_PARAMETERS)
        .does(uploads::append)
        // The body is written to disk as it arrives, and not held in memory.
        .without_body_limit(),
        op(Get, "/healthz", Public, "Whether the process runs.")
            .answers(200, TEXT)
            .does(async || "ok\n"),
        op(Get, "/readyz", Public, "Whether sessions can be opened.")
            .answers(200, TEXT)
            .or(&[(503, "The twins cannot be listed.")])
            .does(ready),
        op(Get, "/v1/openapi.json", Public, "This document.")
            .answers(200, Content::Object)
            .does(openapi::show),
    ];
    // The page itself is public: it has no data, and asks for a token before it shows any.
    rows.extend(viewer::FILES.iter().map(|&file| {
        let answer = Content::Media(file.media_type());
        let summary = "A file of the viewer.";
        op(Get, file.path, Public, summary).answers(200, answer).does(async move || file.response())
    }));
    rows
}
