//! Strict decoding of messages of clients.
//!
//! serde accepts more than the protocol: an array in place of an object, `null` in place of an
//! absent field, fields that do not exist, and the last of two fields of one name. If an agent has
//! such a mistake, it gets wrong results instead of an error. So a message is first compared with
//! its JSON schema, the one in `protocol/schema` that is generated from the types, and only then
//! read by serde. The rules:
//!
//! - Objects are not arrays. Unknown, missing and duplicate fields are refused.
//! - `null` is refused everywhere: an option that is not set is left out. Where a number belongs,
//!   `null` counts as NaN, because JavaScript writes NaN so.
//! - A number with a point or an exponent is an integer if its value is one, as in JSON Schema:
//!   `1e5`.
//! - NaN and infinities, which JSON cannot represent, are found in all usual spellings
//!   (`non_finite`).
//! - A message is nested at most 127 deep: `serde_json` refuses the 128th level.
//!
//! Every [`Mistake`] has the path of the field, for example `rig.cameras[2].lens.k[1]`. Ranges of
//! numbers, counts and names are not checked here: the package that knows the limit refuses them,
//! with a code of its own.

mod non_finite;
mod shape;
mod tree;
mod walk;

use std::sync::LazyLock;

use serde::de::DeserializeOwned;

use crate::http::{NewActor, NewEdit, NewPush, NewUpload, Rollback};
use crate::message::Request;

use shape::Shapes;
use tree::Tree;

/// A message that clients send, and that has a schema.
pub trait Inbound: DeserializeOwned {
    /// The shapes of its schema.
    #[doc(hidden)]
    fn shapes() -> &'static Shapes;
}

macro_rules! inbound {
    ($message:ty, $schema:literal) => {
        impl Inbound for $message {
            fn shapes() -> &'static Shapes {
                static SHAPES: LazyLock<Shapes> = LazyLock::new(|| {
                    Shapes::from_schema(include_str!(concat!("../../schema/", $schema, ".json")))
                });
                &SHAPES
            }
        }
    };
}

inbound!(Request, "request");
inbound!(NewUpload, "new_upload");
inbound!(NewPush, "new_push");
inbound!(Rollback, "rollback");
inbound!(NewEdit, "new_edit");
inbound!(NewActor, "new_actor");

/// Why a message was refused.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refused {
    /// The message's `seq`, if it has exactly one and it is a number.
    pub seq: Option<u64>,
    /// The first mistake of the message, in the order of its text. A wrong tag comes before the
    /// other fields of its object, and a missing field after them.
    pub mistake: Mistake,
}

/// A mistake in a message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mistake {
    /// Kind of the mistake.
    pub kind: MistakeKind,
    /// Path of the field. `None` if the message is not JSON, or not an object.
    pub field: Option<String>,
    /// Description of the mistake and of the expected value, for people.
    pub reason: String,
}

/// Kinds of mistakes. Each has its own error code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MistakeKind {
    /// Not JSON, or nested too deeply.
    NotJson,
    /// A field is missing, unknown, doubled, `null` or of the wrong type.
    Invalid,
    /// A number of a pose is NaN, infinite or `null`.
    PoseNotFinite,
    /// Another number is NaN, infinite or `null`, or an integer does not fit its type.
    OutOfRange,
    /// The schema accepts the message, but the type does not: a bug of this package.
    Defect,
}

/// Reads a message.
///
/// ```
/// use wildcity_protocol::decode::decode;
/// use wildcity_protocol::message::Request;
///
/// let closing = decode::<Request>(r#"{"type": "close", "seq": 2e0}"#).unwrap();
/// assert_eq!(closing, Request::Close { seq: 2, session: None });
///
/// let text = r#"{"type": "observe", "seq": 3, "poses": [{"xyz": [0, 0, 0]}]}"#;
/// let refused = decode::<Request>(text).unwrap_err();
/// assert_eq!(refused.seq, Some(3));
/// assert_eq!(refused.mistake.field.as_deref(), Some("poses[0].q"));
/// ```
///
/// # Errors
/// The first mistake in the order of the text; a missing field comes after the fields of its
/// object.
pub fn decode<T: Inbound>(text: &str) -> Result<T, Refused> {
    let tree = match Tree::parse(text) {
        Ok(tree) => tree,
        // Only if the text is JSON apart from numbers that are not finite.
        Err(error) => match Tree::parse(&non_finite::without_infinities(text)) {
            Ok(tree) => tree,
            Err(_) => {
                let mistake = Mistake { kind: MistakeKind::NotJson, field: None, reason: error };
                return Err(Refused { seq: None, mistake });
            }
        },
    };
    let refused = |mistake| Refused { seq: walk::seq(&tree), mistake };
    // From here on integers are written as their types need them, so that serde reads `1e5` as
    // well.
    let value = walk::checked(T::shapes(), &tree).map_err(refused)?;
    serde_json::from_value(value).map_err(|error| {
        let reason = format!("the schema accepts what the type does not: {error}");
        refused(Mistake { kind: MistakeKind::Defect, field: None, reason })
    })
}
