//! Types and fields of a JSON schema, in a form that is fast to compare with.
//!
//! Only the keywords that schemars writes for this package's types are read. Ranges, counts and
//! name patterns are checked by the packages that have the limits.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use serde_json::{Map, Value};

/// The shapes of a schema.
#[derive(Debug)]
pub struct Shapes {
    pub(super) root: Shape,
    /// By name, as `$ref` has it.
    pub(super) definitions: BTreeMap<String, Shape>,
}

#[derive(Debug)]
pub(super) enum Shape {
    /// A value of any type except `null`.
    Any,
    Boolean,
    /// A finite number, whole or not.
    Number,
    /// A whole number that fits a type.
    Integer(RangeInclusive<i128>),
    Text,
    /// One of some strings.
    Word(Vec<String>),
    /// A list; if `len` is given, of exactly this number of items.
    List {
        item: Box<Shape>,
        len: Option<usize>,
    },
    Object(ObjectShape),
    /// Objects that differ by the string in the field `tag`.
    Tagged {
        tag: String,
        variants: BTreeMap<String, ObjectShape>,
    },
    /// One of several shapes.
    Choice(Vec<Shape>),
    /// The definition of that name.
    Defined(String),
}

/// The fields of an object.
#[derive(Debug)]
pub(super) struct ObjectShape {
    pub(super) fields: BTreeMap<String, Shape>,
    pub(super) required: Vec<String>,
    /// Values of fields of any other name, which are refused if there is no shape.
    pub(super) others: Option<Box<Shape>>,
}

impl Shapes {
    /// Reads a schema of this package.
    ///
    /// # Panics
    /// The schema has a keyword that this module does not support. A test reads every schema.
    pub(super) fn from_schema(schema: &str) -> Self {
        let schema: Value = serde_json::from_str(schema).expect("a schema is JSON");
        let definitions = schema["$defs"]
            .as_object()
            .into_iter()
            .flatten()
            .map(|(name, schema)| (name.clone(), Shape::from_value(schema)));
        Self { root: Shape::from_value(&schema), definitions: definitions.collect() }
    }

    /// The shape behind the names of definitions.
    pub(super) fn resolve<'a>(&'a self, shape: &'a Shape) -> &'a Shape {
        match shape {
            Shape::Defined(name) => self.resolve(&self.definitions[name]),
            shape => shape,
        }
    }
}

impl Shape {
    fn from_value(schema: &Value) -> Self {
        // A schema may also be `true`, which accepts anything.
        let Some(keywords) = schema.as_object() else { return Self::Any };
        if let Some(Value::String(target)) = keywords.get("$ref") {
            return Self::Defined(target.trim_start_matches("#/$defs/").to_owned());
        }
        // In addition to `properties`, `oneOf` says which fields exclude each other. serde's types
        // check this.
        let alternatives = ["anyOf", "oneOf"].into_iter().find_map(|name| keywords.get(name));
        if let Some(Value::Array(alternatives)) = alternatives
            && !keywords.contains_key("properties")
        {
            return Self::from_alternatives(alternatives);
        }
        if let Some(word) = keywords.get("const").or(keywords.get("enum")) {
            return Self::Word(strings(word));
        }
        match keywords.get("type").and_then(Value::as_str) {
            None => Self::Any,
            Some("boolean") => Self::Boolean,
            Some("number") => Self::Number,
            Some("integer") => Self::Integer(integers(keywords)),
            Some("string") => Self::Text,
            Some("array") => {
                let least = keywords.get("minItems").and_then(Value::as_u64);
                let most = keywords.get("maxItems").and_then(Value::as_u64);
                // Only a fixed length is a matter of type: other limits are checked where they are
                // defined.
                let len = least.filter(|_| least == most).map(|len| len as usize);
                let item = keywords.get("items").map_or(Self::Any, Self::from_value);
                Self::List { item: Box::new(item), len }
            }
            Some("object") => Self::Object(ObjectShape::from_keywords(keywords)),
            Some(other) => panic!("type {other}"),
        }
    }

    fn from_alternatives(alternatives: &[Value]) -> Self {
        // An enumeration whose values have descriptions is a list of constants in the schema.
        let shapes: Vec<Self> = alternatives.iter().map(Self::from_value).collect();
        if shapes.iter().all(|shape| matches!(shape, Self::Word(_))) {
            let words = shapes.into_iter().flat_map(|shape| match shape {
                Self::Word(words) => words,
                _ => Vec::new(),
            });
            return Self::Word(words.collect());
        }
        match tag(&shapes) {
            Some(tag) => {
                let variants = shapes.into_iter().filter_map(|shape| match shape {
                    Self::Object(object) => Some((object.word(&tag)?.to_owned(), object)),
                    _ => None,
                });
                Self::Tagged { variants: variants.collect(), tag }
            }
            None => Self::Choice(shapes),
        }
    }
}

impl ObjectShape {
    fn from_keywords(keywords: &Map<String, Value>) -> Self {
        let fields = keywords.get("properties").and_then(Value::as_object).into_iter().flatten();
        let others = match keywords.get("additionalProperties") {
            // In JSON Schema an absent keyword accepts any field. Types that answers have, too,
            // ignore unknown fields there and so lack the keyword; in a request a field that is not
            // read is a mistake.
            None | Some(Value::Bool(false)) => None,
            Some(shape) => Some(Box::new(Shape::from_value(shape))),
        };
        Self {
            fields: fields
                .map(|(name, schema)| (name.clone(), Shape::from_value(schema)))
                .collect(),
            required: keywords.get("required").map(strings).unwrap_or_default(),
            others,
        }
    }

    /// The only allowed text of a field.
    fn word(&self, field: &str) -> Option<&str> {
        match self.fields.get(field) {
            Some(Shape::Word(words)) if words.len() == 1 => Some(&words[0]),
            _ => None,
        }
    }
}

/// The field that distinguishes objects, if there is one: its text is different in each of them.
fn tag(shapes: &[Shape]) -> Option<String> {
    let Some(Shape::Object(first)) = shapes.first() else { return None };
    let tells_apart = |field: &&String| {
        shapes.iter().all(|shape| match shape {
            Shape::Object(object) => object.word(field).is_some(),
            _ => false,
        })
    };
    first.fields.keys().find(tells_apart).cloned()
}

/// The numbers of the type that schemars names in `format`.
fn integers(keywords: &Map<String, Value>) -> RangeInclusive<i128> {
    match keywords.get("format").and_then(Value::as_str) {
        Some("uint8") => 0..=u8::MAX.into(),
        Some("uint32") => 0..=u32::MAX.into(),
        Some("uint64") => 0..=u64::MAX.into(),
        Some("int32") => i32::MIN.into()..=i32::MAX.into(),
        Some("int64") => i64::MIN.into()..=i64::MAX.into(),
        other => panic!("an integer of format {other:?}"),
    }
}

/// A string, or those of a list.
fn strings(value: &Value) -> Vec<String> {
    match value {
        Value::Array(values) => {
            values.iter().filter_map(Value::as_str).map(str::to_owned).collect()
        }
        value => value.as_str().map(str::to_owned).into_iter().collect(),
    }
}
