//! Compares a message with its schema, field by field.

use std::collections::BTreeSet;

use serde_json::{Map, Number, Value};

use super::shape::{ObjectShape, Shape, Shapes};
use super::tree::Tree;
use super::{Mistake, MistakeKind};

/// Integers up to here are exact as floating-point numbers: 2^53. A larger number with a point or
/// an exponent may stand for several integers.
const EXACT: i128 = 1 << 53;

/// Longest name of an unknown field that a path repeats, in characters.
const NAME_CHARS: usize = 64;

/// The message with its numbers as the types require them, or its first mistake.
pub(super) fn checked(shapes: &Shapes, tree: &Tree) -> Result<Value, Mistake> {
    Walk { shapes, path: String::new(), in_pose: false }.value(&shapes.root, tree)
}

/// The field `seq` of a message, if there is exactly one, and it is a number.
pub(super) fn seq(tree: &Tree) -> Option<u64> {
    let Tree::Object(fields) = tree else { return None };
    let mut numbers = fields.iter().filter(|(name, _)| name == "seq");
    match (numbers.next(), numbers.next()) {
        (Some((_, Tree::Number(number))), None) if is_exact(number) => {
            integer(number).and_then(|number| u64::try_from(number).ok())
        }
        _ => None,
    }
}

struct Walk<'a> {
    shapes: &'a Shapes,
    /// Path of the value that is compared.
    path: String,
    /// Whether this value is within a pose.
    in_pose: bool,
}

impl Walk<'_> {
    fn value(&mut self, shape: &Shape, tree: &Tree) -> Result<Value, Mistake> {
        if let Shape::Defined(name) = shape {
            let outer = self.in_pose;
            // A pose that is not finite has an error code of its own.
            self.in_pose |= name == "Pose";
            let value = self.value(&self.shapes.definitions[name], tree);
            self.in_pose = outer;
            return value;
        }
        match (shape, tree) {
            (Shape::Number, Tree::Null) => {
                let kind =
                    if self.in_pose { MistakeKind::PoseNotFinite } else { MistakeKind::OutOfRange };
                let reason = "is not finite; a finite number is expected here";
                Err(self.mistake(kind, reason))
            }
            (_, Tree::Null) => {
                let reason = "is null; leave the field out, or give it a value";
                Err(self.mistake(MistakeKind::Invalid, reason))
            }
            (Shape::Any, tree) => self.any(tree),
            (Shape::Boolean, Tree::Boolean(value)) => Ok(Value::Bool(*value)),
            (Shape::Number, Tree::Number(number)) => {
                Ok(number.as_f64().and_then(Number::from_f64).map_or(Value::Null, Value::Number))
            }
            (Shape::Integer(accepted), Tree::Number(number)) => {
                let Some(whole) = integer(number) else {
                    return Err(self.wrong("expected an integer, found a fraction"));
                };
                // Before exactness: a number beyond the range is too large however it is written.
                if !accepted.contains(&whole) {
                    let reason = format!(
                        "is {number}; {} to {} is accepted",
                        accepted.start(),
                        accepted.end()
                    );
                    return Err(self.mistake(MistakeKind::OutOfRange, &reason));
                }
                if !is_exact(number) {
                    let reason = "write an integer of this size without a point or an exponent";
                    return Err(self.wrong(reason));
                }
                // Every accepted range is within u64 or i64: what is not the first is the second.
                let unsigned = u64::try_from(whole).map(Value::from);
                Ok(unsigned.unwrap_or_else(|_| Value::from(whole as i64)))
            }
            (Shape::Text, Tree::Text(text)) => Ok(Value::String(text.clone())),
            (Shape::Word(words), Tree::Text(text)) if words.contains(text) => {
                Ok(Value::String(text.clone()))
            }
            (Shape::Word(words), Tree::Text(text)) => {
                let known = words.join(", ");
                Err(self.wrong(&format!("there is no {:?}; there is {known}", shortened(text))))
            }
            (Shape::List { item, len }, Tree::List(items)) => self.list(item, *len, items),
            (Shape::Object(object), Tree::Object(fields)) => self.object(object, fields),
            (Shape::Tagged { tag, variants }, Tree::Object(fields)) => {
                let variant = fields.iter().find(|(name, _)| name == tag);
                let words = || variants.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
                let variant = match variant {
                    Some((_, Tree::Text(word))) => variants.get(word).ok_or_else(|| {
                        let word = shortened(word);
                        format!("there is no {word:?}; there is {}", words())
                    }),
                    Some((_, other)) => {
                        Err(format!("expected one of {}, found {}", words(), other.kind()))
                    }
                    None => Err(format!("the field is missing; there is {}", words())),
                };
                match variant {
                    Ok(object) => self.object(object, fields),
                    Err(reason) => self.within(tag, |walk| Err(walk.wrong(&reason))),
                }
            }
            (Shape::Choice(shapes), tree) => self.choice(shapes, tree),
            (shape, tree) => {
                Err(self.wrong(&format!("expected {}, found {}", self.name(shape), tree.kind())))
            }
        }
    }

    fn list(&mut self, item: &Shape, len: Option<usize>, items: &[Tree]) -> Result<Value, Mistake> {
        if let Some(len) = len.filter(|&len| len != items.len()) {
            return Err(self.wrong(&format!("expected {len} values, found {}", items.len())));
        }
        let mut values = Vec::with_capacity(items.len());
        for (index, tree) in items.iter().enumerate() {
            values.push(self.within(&format!("[{index}]"), |walk| walk.value(item, tree))?);
        }
        Ok(Value::Array(values))
    }

    fn object(&mut self, shape: &ObjectShape, fields: &[(String, Tree)]) -> Result<Value, Mistake> {
        let mut seen = BTreeSet::new();
        let mut values = Map::new();
        for (name, tree) in fields {
            // In the order of the text, so that the first mistake that is reported is the first in
            // the message.
            let value = self.within(&quoted(name), |walk| {
                let Some(inner) = shape.fields.get(name).or(shape.others.as_deref()) else {
                    let known: Vec<&str> = shape.fields.keys().map(String::as_str).collect();
                    let reason = format!("there is no such field; there is {}", known.join(", "));
                    return Err(walk.wrong(&reason));
                };
                if !seen.insert(name) {
                    return Err(walk.wrong("the field occurs twice"));
                }
                walk.value(inner, tree)
            })?;
            values.insert(name.clone(), value);
        }
        match shape.required.iter().find(|name| !seen.contains(name)) {
            None => Ok(Value::Object(values)),
            Some(missing) => self.within(missing, |walk| Err(walk.wrong("the field is missing"))),
        }
    }

    /// Compares a value with the most likely one of several shapes: of its own type, and among
    /// objects the shape that has the most of its fields.
    fn choice(&mut self, shapes: &[Shape], tree: &Tree) -> Result<Value, Mistake> {
        let mut best: Option<(usize, &Shape)> = None;
        let mut objects: Vec<String> = Vec::new();
        for shape in shapes {
            let known = match (self.shapes.resolve(shape), tree) {
                (Shape::Object(object), Tree::Object(fields)) => {
                    objects.push(object.required.join(" and "));
                    fields.iter().filter(|(name, _)| object.fields.contains_key(name)).count()
                }
                (Shape::Text | Shape::Word(_), Tree::Text(_))
                | (Shape::List { .. }, Tree::List(_)) => 1,
                _ => continue,
            };
            // Of two that fit equally well, the first stays, so that the message is the same every
            // time.
            if best.is_none_or(|(most, _)| known > most) {
                best = Some((known, shape));
            }
        }
        match (best, tree) {
            (Some((0, _)), Tree::Object(fields)) if fields.is_empty() && objects.len() > 1 => {
                Err(self.wrong(&format!("give exactly one of {}", objects.join(", "))))
            }
            (Some((_, shape)), tree) => self.value(shape, tree),
            (None, tree) => {
                let names: Vec<&str> = shapes.iter().map(|shape| self.name(shape)).collect();
                let names = names.join(" or ");
                Err(self.wrong(&format!("expected {names}, found {}", tree.kind())))
            }
        }
    }

    /// A value of any type; `null` and doubled fields are refused within it too.
    fn any(&mut self, tree: &Tree) -> Result<Value, Mistake> {
        match tree {
            Tree::Null => self.value(&Shape::Any, tree),
            Tree::Boolean(value) => Ok(Value::Bool(*value)),
            Tree::Number(number) => Ok(Value::Number(number.clone())),
            Tree::Text(text) => Ok(Value::String(text.clone())),
            Tree::List(items) => self.list(&Shape::Any, None, items),
            Tree::Object(fields) => {
                // Without fields of its own, so that `others` accepts every name.
                let any = ObjectShape {
                    fields: Default::default(),
                    required: Vec::new(),
                    others: Some(Box::new(Shape::Any)),
                };
                self.object(&any, fields)
            }
        }
    }

    /// Runs `inner` with the path of a field or an index of the present value.
    fn within<T>(&mut self, part: &str, inner: impl FnOnce(&mut Self) -> T) -> T {
        let length = self.path.len();
        if !self.path.is_empty() && !part.starts_with('[') {
            self.path.push('.');
        }
        self.path.push_str(part);
        let done = inner(self);
        // One string for all levels: a path of its own for each value would allocate for every
        // number.
        self.path.truncate(length);
        done
    }

    fn wrong(&self, reason: &str) -> Mistake {
        self.mistake(MistakeKind::Invalid, reason)
    }

    fn mistake(&self, kind: MistakeKind, reason: &str) -> Mistake {
        if self.path.is_empty() {
            return Mistake { kind, field: None, reason: format!("the message: {reason}") };
        }
        // A sentence with the field as its subject needs no colon.
        let colon = if reason.starts_with("is ") { "" } else { ":" };
        let reason = format!("{}{colon} {reason}", self.path);
        Mistake { kind, field: Some(self.path.clone()), reason }
    }

    /// Name of a shape, for messages.
    fn name(&self, shape: &Shape) -> &'static str {
        match self.shapes.resolve(shape) {
            Shape::Any | Shape::Defined(_) => "a value",
            Shape::Boolean => "true or false",
            Shape::Number => "a number",
            Shape::Integer(_) => "an integer",
            Shape::Text | Shape::Word(_) => "a string",
            Shape::List { .. } => "an array",
            Shape::Object(_) | Shape::Tagged { .. } => "an object",
            Shape::Choice(_) => "another type",
        }
    }
}

/// Whether a number stands for exactly one integer, if it is an integer.
fn is_exact(number: &Number) -> bool {
    let has_point = !number.is_u64() && !number.is_i64();
    !has_point || integer(number).is_some_and(|whole| whole.abs() <= EXACT)
}

/// The value of a number that is whole.
fn integer(number: &Number) -> Option<i128> {
    if let Some(number) = number.as_u64() {
        return Some(number.into());
    }
    if let Some(number) = number.as_i64() {
        return Some(number.into());
    }
    let number = number.as_f64()?;
    // `as` saturates: no type of the protocol has numbers of this size.
    (number.fract() == 0.0).then_some(number as i128)
}

/// The name of a field, as a path has it: quoted if it has other characters than names have.
fn quoted(name: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
    if !name.is_empty() && name.len() <= NAME_CHARS && name.chars().all(is_plain) {
        name.to_owned()
    } else {
        format!("[{:?}]", shortened(name))
    }
}

/// A text of the client, short enough for a message.
fn shortened(text: &str) -> String {
    match text.char_indices().nth(NAME_CHARS) {
        None => text.to_owned(),
        Some((end, _)) => format!("{}..", &text[..end]),
    }
}

#[cfg(test)]
mod tests {
    use crate::decode::decode;
    use crate::message::Request;

    #[test]
    fn a_refusal_of_a_doubled_number_has_no_number() {
        let text = r#"{"type": "close", "seq": 3, "seq": 4}"#;
        let refused = decode::<Request>(text).unwrap_err();
        assert_eq!(refused.seq, None);
        assert_eq!(refused.mistake.field.as_deref(), Some("seq"));
    }
}
