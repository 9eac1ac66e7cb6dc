//! Catalogs: files beside the scenario, whose entries it refers to.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::rc::Rc;

use roxmltree::{Document, Node};

use super::Settings;
use super::element::{Element, Parameters, Source};
use super::files::{read_text, xml_files};
use super::ledger::Ledger;
use crate::{ConvertError, TEXT_BYTES, xml};

/// Most files of all catalogs.
const FILES: usize = 1000;

/// The text of a catalog's file.
pub(super) struct CatalogText {
    /// For messages: the name of the file, and a blank.
    label: String,
    text: String,
}

/// The entries of all catalogs, by the names of catalog and entry.
pub(super) struct Catalogs<'a> {
    entries: BTreeMap<(String, String), (Node<'a, 'a>, Source<'a>)>,
    ledger: &'a Ledger,
}

/// Reads the files of the catalogs if the scenario refers to any: XML files in directories relative
/// to its own, and in those of the settings.
pub(super) fn read_texts(
    root: &Element<'_>,
    node: Node<'_, '_>,
    settings: &Settings,
) -> Result<Vec<CatalogText>, ConvertError> {
    // Catalogs to which nothing refers need not exist.
    let is_used = node.descendants().any(|node| node.has_tag_name("CatalogReference"));
    let locations = root.find("CatalogLocations")?;
    let dir = settings.directory.as_ref();
    let mut directories: BTreeSet<PathBuf> = BTreeSet::new();
    directories.extend(settings.catalogs.iter().filter(|_| is_used).cloned());
    for catalog in locations.iter().flat_map(Element::children) {
        catalog.only(&["Directory"])?;
        let directory = catalog.need("Directory")?;
        let path = directory.text("path")?;
        if is_used {
            let dir = dir.ok_or_else(|| directory.wrong("needs the directory of the file"))?;
            // Files that were written on Windows have backslashes.
            directories.insert(dir.join(path.replace('\\', "/")));
        }
    }
    let mut texts = Vec::new();
    let mut bytes = 0;
    for directory in directories {
        for path in xml_files(&directory) {
            let text = read_text(&path)?;
            bytes += text.len();
            // The sum is bounded, because such a directory may hold any number of files.
            if texts.len() == FILES || bytes > TEXT_BYTES {
                let place = format!("{}", directory.display());
                let message = format!("at most {FILES} files, {TEXT_BYTES} bytes are read");
                return Err(ConvertError::new(place, message));
            }
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            texts.push(CatalogText { label: format!("{name} "), text });
        }
    }
    Ok(texts)
}

/// Parses the files of catalogs. Files that are no catalogs stay unused.
pub(super) fn parse_documents(texts: &[CatalogText]) -> Vec<(Document<'_>, &str)> {
    let parsed = texts
        .iter()
        .map(|text| Some((xml::parse(&text.text, super::NODES).ok()?, text.label.as_str())));
    parsed.flatten().collect()
}

impl<'a> Catalogs<'a> {
    pub(super) fn new(documents: &'a [(Document<'a>, &'a str)], ledger: &'a Ledger) -> Self {
        let mut entries = BTreeMap::new();
        for (index, (document, label)) in documents.iter().enumerate() {
            // Index 0 is the scenario itself.
            let source = Source { index: index + 1, label };
            let catalogs = document.root_element().children();
            for catalog in catalogs.filter(|node| node.has_tag_name("Catalog")) {
                let name = catalog.attribute("name").unwrap_or_default();
                for entry in catalog.children().filter(Node::is_element) {
                    let key =
                        (name.to_owned(), entry.attribute("name").unwrap_or_default().to_owned());
                    // Of two entries of one name, the first one in the order of the files counts.
                    entries.entry(key).or_insert((entry, source));
                }
            }
        }
        Self { entries, ledger }
    }

    /// The entry that a `<CatalogReference>` names, with its parameters.
    pub(super) fn entry(&self, reference: &Element<'a>) -> Result<Element<'a>, ConvertError> {
        reference.only(&["ParameterAssignments"])?;
        let key = (reference.text("catalogName")?, reference.text("entryName")?);
        let Some((node, source)) = self.entries.get(&key) else {
            let (catalog, entry) = key;
            let message = format!(
                "there is no entry {entry:?} of a catalog {catalog:?} in the directories of <CatalogLocations>"
            );
            return Err(reference.wrong(&message));
        };
        // The entry may use the parameters of the place that refers to it.
        let own = Element::new(*node, reference.parameters().clone(), self.ledger, *source);
        let entry = declared(&own)?;
        let mut parameters = BTreeMap::clone(entry.parameters());
        if let Some(assignments) = reference.find("ParameterAssignments")? {
            assignments.only(&["ParameterAssignment"])?;
            for assignment in assignments.children() {
                let name = plain_parameter(&assignment.raw("parameterRef")?);
                if !parameters.contains_key(&name) {
                    let message = format!(
                        "the entry declares no parameter {name:?}; declare it, or correct the name"
                    );
                    return Err(assignment.wrong(&message));
                }
                parameters.insert(name, assignment.text("value")?);
            }
        }
        Ok(entry.with_parameters(Rc::new(parameters)))
    }
}

/// The name of a parameter without the sign in front of it, which some files write.
pub(super) fn plain_parameter(name: &str) -> String {
    name.trim_start_matches('$').to_owned()
}

/// An element where its own `<ParameterDeclarations>` are known too. Values may use earlier
/// parameters.
pub(super) fn declared<'a>(element: &Element<'a>) -> Result<Element<'a>, ConvertError> {
    declared_with(element, &BTreeMap::new())
}

/// The same with other values for some of them.
pub(super) fn declared_with<'a>(
    element: &Element<'a>,
    given: &BTreeMap<String, String>,
) -> Result<Element<'a>, ConvertError> {
    let Some(section) = element.find("ParameterDeclarations")? else { return Ok(element.clone()) };
    section.only(&["ParameterDeclaration"])?;
    let mut parameters: Parameters = element.parameters().clone();
    for declaration in section.children() {
        // A declaration may use those before it.
        let declaration = declaration.with_parameters(parameters.clone());
        declaration.only(&["ConstraintGroup"])?;
        // A name with its sign is no reference.
        let name = plain_parameter(&declaration.raw("name")?);
        let declared = declaration.text("value")?;
        let value = given.get(&name).cloned().unwrap_or(declared);
        check_constraints(&declaration, &value)?;
        Rc::make_mut(&mut parameters).insert(name, value);
    }
    Ok(element.with_parameters(parameters))
}

/// Refuses a value that meets none of the groups of constraints.
fn check_constraints(declaration: &Element<'_>, value: &str) -> Result<(), ConvertError> {
    let mut groups = declaration.all("ConstraintGroup").peekable();
    if groups.peek().is_none() {
        return Ok(());
    }
    // Of a group all constraints must hold, and one such group is enough.
    let mut meets_any = false;
    for group in groups {
        group.only(&["ValueConstraint"])?;
        let mut meets = true;
        for constraint in group.children() {
            let rule = constraint.text("rule")?;
            let bound = constraint.text("value")?;
            meets &= compare(&rule, value, &bound).ok_or_else(|| {
                constraint.wrong(&format!("{value:?} {rule} {bound:?} is not read"))
            })?;
        }
        meets_any |= meets;
    }
    if meets_any {
        Ok(())
    } else {
        Err(declaration.wrong(&format!("value={value:?} violates its constraints")))
    }
}

/// The value of a comparison of OpenSCENARIO; `None` if texts are compared by size, or for an
/// unknown rule.
pub(super) fn compare(rule: &str, value: &str, bound: &str) -> Option<bool> {
    match rule {
        "equalTo" => return Some(is_same(value, bound)),
        "notEqualTo" => return Some(!is_same(value, bound)),
        _ => {}
    }
    // Only numbers can be compared by size.
    let [value, bound]: [f64; 2] = [value.trim().parse().ok()?, bound.trim().parse().ok()?];
    match rule {
        "greaterThan" => Some(value > bound),
        "greaterOrEqual" => Some(value >= bound),
        "lessThan" => Some(value < bound),
        "lessOrEqual" => Some(value <= bound),
        _ => None,
    }
}

fn is_same(value: &str, bound: &str) -> bool {
    // As numbers if both are: `1` and `1.0` are equal.
    match (value.trim().parse::<f64>(), bound.trim().parse::<f64>()) {
        (Ok(value), Ok(bound)) => value == bound,
        _ => value == bound,
    }
}
