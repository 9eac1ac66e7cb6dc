//! Assets of actors: what other vehicles and pedestrians are drawn from.

use reqwest::Method;

use wildcity_protocol::http::{ActorAsset, ActorList, NewActor};

use crate::http::{HttpClient, HttpError};
use crate::limits;

impl HttpClient {
    /// Asks the server to make an asset of an actor from uploaded files, and returns when it is
    /// stored. The same files with the same options are the same asset, so that a request without
    /// an answer can be sent again.
    ///
    /// # Errors
    /// The server refuses, or does not answer within [`limits::ACTOR_TIMEOUT`].
    pub async fn push_actor(&self, actor: &NewActor) -> Result<ActorAsset, HttpError> {
        let path = ["v1", "actors"];
        self.request_json_within(Method::POST, &path, Some(actor), limits::ACTOR_TIMEOUT).await
    }

    /// All assets of the server, and those that are damaged.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn actors(&self) -> Result<ActorList, HttpError> {
        self.request_json(Method::GET, &["v1", "actors"], None::<&()>).await
    }

    /// The asset of a name, of a hash, or of a hash that begins with at least 4 digits.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn actor(&self, name_or_hash: &str) -> Result<ActorAsset, HttpError> {
        self.request_json(Method::GET, &["v1", "actors", name_or_hash], None::<&()>).await
    }
}
