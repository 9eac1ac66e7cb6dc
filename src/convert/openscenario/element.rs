//! Elements of an OpenSCENARIO file: attributes with parameters, and children that are all known.

use std::collections::BTreeMap;
use std::rc::Rc;

use roxmltree::Node;

use super::expression;
use super::ledger::{Ledger, Part};
use crate::ConvertError;

/// The parameters that are known at a place.
pub(super) type Parameters = Rc<BTreeMap<String, String>>;

/// A file, for messages and for what has been read of it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Source<'a> {
    /// Its index among the files.
    pub(super) index: usize,
    /// In front of a line: empty for the scenario, else the name of the catalog's file.
    pub(super) label: &'a str,
}

/// An element, with the parameters of its place.
#[derive(Clone)]
pub(super) struct Element<'a> {
    node: Node<'a, 'a>,
    parameters: Parameters,
    ledger: &'a Ledger,
    source: Source<'a>,
}

impl<'a> Element<'a> {
    pub(super) fn new(
        node: Node<'a, 'a>,
        parameters: Parameters,
        ledger: &'a Ledger,
        source: Source<'a>,
    ) -> Self {
        // Whatever is made into an element counts as read; its attributes count one by one.
        ledger.element(source.index, node);
        Self { node, parameters, ledger, source }
    }

    fn with_node(&self, node: Node<'a, 'a>) -> Self {
        Self::new(node, self.parameters.clone(), self.ledger, self.source)
    }

    /// The same element where other parameters are known.
    pub(super) fn with_parameters(&self, parameters: Parameters) -> Self {
        Self { parameters, ..self.clone() }
    }

    /// The parameters that are known here.
    pub(super) fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// Refuses whatever has not been read of this element and below it.
    pub(super) fn check_read(&self) -> Result<(), ConvertError> {
        self.ledger.check((self.source.index, self.source.label), self.node)
    }

    pub(super) fn name(&self) -> &'a str {
        self.node.tag_name().name()
    }

    pub(super) fn children(&self) -> impl Iterator<Item = Self> + use<'a> {
        // The iterator owns a copy, so that it borrows nothing of `self`.
        let own = self.clone();
        self.node.children().filter(Node::is_element).map(move |node| own.with_node(node))
    }

    /// The children of a name.
    pub(super) fn all(&self, name: &str) -> impl Iterator<Item = Self> {
        let own = self.clone();
        let nodes = self.node.children().filter(Node::is_element);
        nodes
            .filter(move |node| node.tag_name().name() == name)
            .map(move |node| own.with_node(node))
    }

    /// The only child with a name; `None` without one.
    pub(super) fn find(&self, name: &str) -> Result<Option<Self>, ConvertError> {
        let mut found = self.all(name);
        // A second one is looked for, because it would be ignored in silence otherwise.
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
        // To look at a child marks it as read, but neither its attributes nor what is in it.
        match self.children().find(|child| !known.contains(&child.name())) {
            None => Ok(()),
            Some(unknown) => Err(unknown.unread()),
        }
    }

    /// The element is not understood.
    pub(super) fn unread(&self) -> ConvertError {
        self.wrong("is not read; remove it, or write this part in the scenario file by hand")
    }

    /// Leaves this element out with all below it, if that was asked for.
    ///
    /// # Errors
    /// It was not: names the option.
    pub(super) fn leave_out(&self, part: Part) -> Result<(), ConvertError> {
        let name = part.name();
        if !self.ledger.leave_out.contains(&part) {
            return Err(self.wrong(&format!(
                "is not read; remove it, or leave such parts out with --leave-out {name}"
            )));
        }
        self.mark_left_out();
        self.note(&format!("is left out ({name})"));
        Ok(())
    }

    /// Whether a part is left out.
    pub(super) fn leaves_out(&self, part: Part) -> bool {
        self.ledger.leave_out.contains(&part)
    }

    /// Does not require that this element is read.
    pub(super) fn mark_left_out(&self) {
        self.ledger.leave_out(self.source.index, self.node);
    }

    /// Tells something about this element.
    pub(super) fn note(&self, message: &str) {
        // In the form of a mistake, so that it has the place, too.
        self.ledger.note(self.wrong(message).to_string());
    }

    /// The line on which it begins.
    pub(super) fn line(&self) -> u32 {
        self.node.document().text_pos_at(self.node.range().start).row
    }

    /// A mistake in this element.
    pub(super) fn wrong(&self, message: &str) -> ConvertError {
        let place = format!("{}line {}, <{}>", self.source.label, self.line(), self.name());
        ConvertError::new(place, message)
    }

    /// An attribute with its parameters put in; `None` without it.
    pub(super) fn find_text(&self, name: &str) -> Result<Option<String>, ConvertError> {
        // The ledger names an attribute by its index in the element.
        let found = self.node.attributes().enumerate().find(|(_, one)| one.name() == name);
        let Some((index, attribute)) = found else { return Ok(None) };
        self.ledger.attribute(self.source.index, self.node, index);
        let text = attribute.value().trim();
        let value = expression::text(text, &self.parameters);
        value.map(Some).map_err(|message| self.wrong(&format!("{name}={text:?}: {message}")))
    }

    /// An attribute as it is written.
    pub(super) fn raw(&self, name: &str) -> Result<String, ConvertError> {
        let found = self.node.attributes().enumerate().find(|(_, one)| one.name() == name);
        let Some((index, attribute)) = found else {
            return Err(self.wrong(&format!("the attribute {name} is missing")));
        };
        self.ledger.attribute(self.source.index, self.node, index);
        Ok(attribute.value().trim().to_owned())
    }

    /// The text of an attribute, which must be there.
    pub(super) fn text(&self, name: &str) -> Result<String, ConvertError> {
        self.find_text(name)?.ok_or_else(|| self.wrong(&format!("the attribute {name} is missing")))
    }

    /// An attribute that is a finite number; `None` without it.
    pub(super) fn find_number(&self, name: &str) -> Result<Option<f64>, ConvertError> {
        let Some(text) = self.find_text(name)? else { return Ok(None) };
        // `inf` and `NaN` are numbers for the parser of Rust.
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

    /// An attribute that is a finite number; 0 without it.
    pub(super) fn number_or_0(&self, name: &str) -> Result<f64, ConvertError> {
        Ok(self.find_number(name)?.unwrap_or(0.0))
    }

    /// An attribute that is a whole number.
    pub(super) fn whole(&self, name: &str) -> Result<i32, ConvertError> {
        let value = self.number(name)?;
        // Within 1e9 the cast to i32 is exact.
        if value.fract() == 0.0 && value.abs() < 1e9 {
            Ok(value as i32)
        } else {
            Err(self.wrong(&format!("{name}={value:?}; write a whole number")))
        }
    }

    /// An attribute that is true or false; `None` without it.
    pub(super) fn find_flag(&self, name: &str) -> Result<Option<bool>, ConvertError> {
        match self.find_text(name)?.as_deref() {
            None => Ok(None),
            Some("true" | "1") => Ok(Some(true)),
            Some("false" | "0") => Ok(Some(false)),
            Some(other) => Err(self.wrong(&format!("{name}={other:?}; write true or false"))),
        }
    }

    /// Takes note of attributes that do not matter in this place.
    pub(super) fn ignore(&self, names: &[&str]) -> Result<(), ConvertError> {
        names.iter().try_for_each(|name| self.find_text(name).map(|_| ()))
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
