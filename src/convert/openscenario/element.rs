//! Elements of an OpenSCENARIO file: attributes with parameters, and children that are all known.

use std::collections::BTreeMap;

use roxmltree::Node;

use super::expression;
use crate::ConvertError;

/// An element, with the parameters of its file.
#[derive(Clone, Copy)]
pub(super) struct Element<'a> {
    node: Node<'a, 'a>,
    parameters: &'a BTreeMap<String, String>,
}

impl<'a> Element<'a> {
    pub(super) fn new(node: Node<'a, 'a>, parameters: &'a BTreeMap<String, String>) -> Self {
        Self { node, parameters }
    }

    /// Its name.
    pub(super) fn name(&self) -> &'a str {
        self.node.tag_name().name()
    }

    /// The child elements.
    pub(super) fn children(&self) -> impl Iterator<Item = Self> + use<'a> {
        let parameters = self.parameters;
        self.node.children().filter(Node::is_element).map(move |node| Self { node, parameters })
    }

    /// The children of a name.
    pub(super) fn all(&self, name: &str) -> impl Iterator<Item = Self> {
        self.children().filter(move |child| child.name() == name)
    }

    /// The only child with a name; `None` without one.
    pub(super) fn find(&self, name: &str) -> Result<Option<Self>, ConvertError> {
        let mut found = self.all(name);
        let first = found.next();
        match found.next() {
            None => Ok(first),
            Some(second) => Err(second.wrong(&format!("a second <{name}> is not read; keep one"))),
        }
    }

    /// The only child of a name.
    pub(super) fn need(&self, name: &str) -> Result<Self, ConvertError> {
        self.find(name)?.ok_or_else(|| self.wrong(&format!("<{name}> is missing")))
    }

    /// The only child, whatever its name.
    pub(super) fn only_child(&self) -> Result<Self, ConvertError> {
        let mut children = self.children();
        match (children.next(), children.next()) {
            (Some(child), None) => Ok(child),
            (_, Some(second)) => Err(second.wrong("a second element is not read here; keep one")),
            (None, None) => Err(self.wrong("is empty")),
        }
    }

    /// Refuses children of other names.
    pub(super) fn only(&self, known: &[&str]) -> Result<(), ConvertError> {
        match self.children().find(|child| !known.contains(&child.name())) {
            None => Ok(()),
            Some(unknown) => Err(unknown.unread()),
        }
    }

    /// The element is not understood.
    pub(super) fn unread(&self) -> ConvertError {
        self.wrong("is not read; remove it, or write this part in the scenario file by hand")
    }

    /// A mistake in this element.
    pub(super) fn wrong(&self, message: &str) -> ConvertError {
        let line = self.node.document().text_pos_at(self.node.range().start).row;
        ConvertError::new(format!("line {line}, <{}>", self.name()), message)
    }

    /// An attribute with its parameters put in; `None` without it.
    pub(super) fn find_text(&self, name: &str) -> Result<Option<String>, ConvertError> {
        let Some(text) = self.node.attribute(name) else { return Ok(None) };
        let text = text.trim();
        let value = match text.strip_prefix('$') {
            None => return Ok(Some(text.to_owned())),
            Some(rest) => match rest.strip_prefix('{').and_then(|rest| rest.strip_suffix('}')) {
                Some(formula) => expression::value(formula, self.parameters).map(|v| v.to_string()),
                None => self
                    .parameters
                    .get(rest)
                    .cloned()
                    .ok_or_else(|| format!("there is no parameter {rest:?}; declare it")),
            },
        };
        value.map(Some).map_err(|message| self.wrong(&format!("{name}={text:?}: {message}")))
    }

    /// An attribute.
    pub(super) fn text(&self, name: &str) -> Result<String, ConvertError> {
        self.find_text(name)?.ok_or_else(|| self.wrong(&format!("the attribute {name} is missing")))
    }

    /// An attribute that is a finite number; `None` without it.
    pub(super) fn find_number(&self, name: &str) -> Result<Option<f64>, ConvertError> {
        let Some(text) = self.find_text(name)? else { return Ok(None) };
        let number: Option<f64> = text.parse().ok().filter(|number: &f64| number.is_finite());
        number
            .map(Some)
            .ok_or_else(|| self.wrong(&format!("{name}={text:?}; write a finite number")))
    }

    /// An attribute that is a finite number.
    pub(super) fn number(&self, name: &str) -> Result<f64, ConvertError> {
        self.find_number(name)?
            .ok_or_else(|| self.wrong(&format!("the attribute {name} is missing")))
    }

    /// Refuses an attribute of another value.
    pub(super) fn expect(&self, name: &str, values: &[&str]) -> Result<(), ConvertError> {
        match self.find_text(name)? {
            Some(text) if !values.contains(&text.as_str()) => {
                let values = values.join(" or ");
                Err(self.wrong(&format!("{name}={text:?} is not read; only {values}")))
            }
            _ => Ok(()),
        }
    }
}
