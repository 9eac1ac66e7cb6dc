//! The Rust files of every package, and the paths that each of them names.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use syn::spanned::Spanned;
use syn::visit::{self, Visit};

use crate::root;

/// A package of the workspace.
#[derive(Debug)]
pub(crate) struct Package {
    /// `wildcity-render`.
    pub(crate) name: String,
    /// Packages of the workspace that it depends on outside of tests, sorted.
    pub(crate) depends_on: Vec<String>,
    /// Text of each file, by its path within the package's source folder: `cpu/sort.rs`.
    pub(crate) files: BTreeMap<String, String>,
    /// The source folder, from the root of the repository: `src/render`.
    pub(crate) folder: String,
    /// Whether its lints are those of the workspace.
    pub(crate) inherits_lints: bool,
}

#[derive(Deserialize)]
struct Manifest {
    package: Name,
    lib: Option<Library>,
    #[serde(default)]
    bin: Vec<Library>,
    #[serde(default)]
    dependencies: BTreeMap<String, toml::Value>,
    lints: BTreeMap<String, toml::Value>,
}

#[derive(Deserialize)]
struct Name {
    name: String,
}

#[derive(Deserialize)]
struct Library {
    path: Option<String>,
}

/// Every package of the workspace. The root package is the command line: `src/cli`.
pub(crate) fn packages() -> Vec<Package> {
    #[derive(Deserialize)]
    struct Workspace {
        workspace: Members,
    }
    #[derive(Deserialize)]
    struct Members {
        members: Vec<String>,
    }
    let text = fs::read_to_string(root().join("Cargo.toml")).unwrap();
    let members = toml::from_str::<Workspace>(&text).unwrap().workspace.members;
    let mut packages = vec![package("")];
    let own = |member: &&String| *member != "tests/tidy";
    packages.extend(members.iter().filter(own).map(|member| package(member)));
    assert!(packages.len() > 8, "the packages are elsewhere");
    packages
}

fn package(member: &str) -> Package {
    let text = fs::read_to_string(root().join(member).join("Cargo.toml")).unwrap();
    let manifest: Manifest = toml::from_str(&text).unwrap();
    let first = manifest.lib.into_iter().chain(manifest.bin).next();
    let library = first.and_then(|root| root.path).unwrap_or("src/lib.rs".to_owned());
    let folder = match member {
        "" => PathBuf::from("src/cli"),
        _ => Path::new(member).join(Path::new(&library).parent().unwrap()),
    };
    let own = |name: &&String| name.starts_with("wildcity-");
    let mut depends_on: Vec<String> = manifest.dependencies.keys().filter(own).cloned().collect();
    depends_on.sort();
    let files = rust_files(&root().join(&folder));
    Package {
        name: manifest.package.name,
        depends_on,
        files,
        inherits_lints: manifest.lints.contains_key("workspace"),
        folder: folder.to_str().unwrap().trim_end_matches('/').to_owned(),
    }
}

/// Text of every Rust file below a folder, by its path from there.
pub(crate) fn rust_files(folder: &Path) -> BTreeMap<String, String> {
    let mut files = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let name = path.strip_prefix(folder).unwrap().to_str().unwrap().to_owned();
                files.insert(name, fs::read_to_string(&path).unwrap());
            }
        }
    }
    assert!(!files.is_empty(), "no Rust file in {}", folder.display());
    files
}

/// A path that code names, as `["crate", "cpu", "bin"]` or `["axum", "Router"]`, and its line, from
/// 1. `self` and `super` are resolved: paths in the package start with `crate`.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Named {
    pub(crate) path: Vec<String>,
    pub(crate) line: usize,
}

/// Every path that a file names outside of its tests.
pub(crate) fn paths(file: &str, text: &str) -> Vec<Named> {
    let tree = syn::parse_file(text).unwrap_or_else(|error| panic!("{file}: {error}"));
    let mut reader = Reader { module: module(file), found: Vec::new() };
    reader.visit_file(&tree);
    reader.found
}

/// The module of a file, as `["cpu", "bin"]`; none for `lib.rs`.
pub(crate) fn module(file: &str) -> Vec<String> {
    let stem = file.trim_end_matches(".rs");
    let parts = stem.split('/').filter(|part| !["mod", "lib", "main"].contains(part));
    parts.map(str::to_owned).collect()
}

struct Reader {
    module: Vec<String>,
    found: Vec<Named>,
}

impl Reader {
    fn name(&mut self, path: Vec<String>, line: usize) {
        let path = self.resolved(path);
        self.found.push(Named { path, line });
    }

    fn tree(&mut self, before: &[String], tree: &syn::UseTree) {
        let longer = |ident: &syn::Ident| {
            let mut path = before.to_vec();
            path.push(ident.to_string());
            path
        };
        match tree {
            syn::UseTree::Path(path) => self.tree(&longer(&path.ident), &path.tree),
            syn::UseTree::Name(name) => self.name(longer(&name.ident), name.span().start().line),
            syn::UseTree::Rename(name) => self.name(longer(&name.ident), name.span().start().line),
            syn::UseTree::Glob(glob) => {
                let mut path = before.to_vec();
                path.push("*".to_owned());
                self.name(path, glob.span().start().line);
            }
            syn::UseTree::Group(group) => {
                group.items.iter().for_each(|item| self.tree(before, item));
            }
        }
    }

    /// Replaces `self` and `super` at the start by the modules that they mean.
    fn resolved(&self, path: Vec<String>) -> Vec<String> {
        let supers = path.iter().filter(|word| *word == "super").count();
        let skip = path.iter().take_while(|word| *word == "self" || *word == "super").count();
        if skip == 0 {
            return path;
        }
        let module = &self.module[..self.module.len().saturating_sub(supers)];
        let start = std::iter::once("crate".to_owned()).chain(module.iter().cloned());
        start.chain(path[skip..].iter().cloned()).collect()
    }
}

impl<'ast> Visit<'ast> for Reader {
    fn visit_item_mod(&mut self, module: &'ast syn::ItemMod) {
        let is_test = module.attrs.iter().any(|attribute| {
            attribute.path().is_ident("cfg")
                && attribute.parse_args::<syn::Ident>().is_ok_and(|ident| ident == "test")
        });
        if is_test {
            return;
        }
        self.module.push(module.ident.to_string());
        visit::visit_item_mod(self, module);
        self.module.pop();
    }

    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        self.tree(&[], &item.tree);
    }

    fn visit_item_extern_crate(&mut self, item: &'ast syn::ItemExternCrate) {
        self.name(vec![item.ident.to_string()], item.span().start().line);
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let words: Vec<String> = path.segments.iter().map(|part| part.ident.to_string()).collect();
        if words.len() > 1 {
            self.name(words, path.span().start().line);
        }
        visit::visit_path(self, path);
    }

    /// Arguments of a macro are tokens: paths are found among them as words joined by `::`.
    fn visit_macro(&mut self, item: &'ast syn::Macro) {
        let text = item.tokens.to_string().replace(" :: ", "::");
        let words = text.split(|c: char| !(c.is_alphanumeric() || c == '_' || c == ':'));
        let line = item.span().start().line;
        for word in words.filter(|word| word.contains("::") && !word.starts_with("::")) {
            self.name(word.split("::").map(str::to_owned).collect(), line);
        }
    }
}

#[test]
fn paths_are_found_wherever_they_stand() {
    let text = r##"//! As in [`crate::server`].
use super::{bin::{self, Bins}, sort as order};
use axum as web;
/* axum::Router */
const A: &str = "crate::server";
fn f<'a>(x: &'a crate::view::View) -> Vec<crate::scan::Scan> { tokio::fs::read(x).unwrap() }
mod inner { use super::super::lanes::Vec3x16; }
#[cfg(test)]
mod tests { use crate::never; }
fn g() { assert_eq!(crate::stage::A, 1, "crate::text"); }
"##;
    let found = paths("cpu/project.rs", text);
    let found: Vec<String> = found.iter().map(|named| named.path.join("::")).collect();
    for wanted in [
        "crate::cpu::bin::self",
        "crate::cpu::bin::Bins",
        "crate::cpu::sort",
        "axum",
        "crate::view::View",
        "crate::scan::Scan",
        "tokio::fs::read",
        "crate::cpu::lanes::Vec3x16",
        "crate::stage::A",
    ] {
        assert!(found.iter().any(|path| path == wanted), "{wanted} in {found:?}");
    }
    assert!(!found.iter().any(|path| path.contains("server") || path.contains("never")));
}
