//! The source reads as other Rust does: the names, forms and comments that a reader of Rust
//! expects.
//!
//! `cargo test --test tidy dialect -- --nocapture` prints the table that the limits below are
//! checked against.

use std::fmt;

use syn::spanned::Spanned;
use syn::visit::{self, Visit};

use crate::root;
use crate::source::rust_files;

/// What users of the program run, and what they link to.
const PRODUCTION: &[&str] = &["src", "protocol/src", "clients/rust"];

/// What the rest of the source is being brought down to; each is the count of today.
const ERROR_CLOSURES: usize = 102;
const BINDINGS: usize = 2;
const REBINDINGS: usize = 29;
const SHORT_DOCS: usize = 183;
/// Plain comments, which say why, of 1,000 lines.
const PLAIN_PER_MILLE: usize = 40;

/// Columns of a line of comment; rustfmt keeps those of code.
const MOST_COLUMNS: usize = 100;

/// One count of the source, and the most of it that passes.
struct Row {
    name: &'static str,
    places: Vec<String>,
    most: usize,
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:52} {:>6} (at most {})", self.name, self.places.len(), self.most)
    }
}

/// Forms that this source does not use, by the lines on which they begin.
#[derive(Default)]
struct Dialect {
    names: Vec<usize>,
    bool_matches: Vec<usize>,
    tuple_lets: Vec<usize>,
    error_closures: Vec<usize>,
    rebindings: Vec<usize>,
    undocumented: Vec<usize>,
}

impl Dialect {
    fn read(text: &str) -> Self {
        let mut dialect = Self::default();
        dialect.visit_file(&syn::parse_file(text).expect("the source compiles"));
        dialect
    }

    /// `of`, `length_of`, `of_length`: a constructor is `new` or `from_x`, and any other function
    /// is a verb or what it returns.
    fn check_name(&mut self, name: &syn::Ident) {
        let text = name.to_string();
        if text == "of" || text.ends_with("_of") || text.starts_with("of_") {
            self.names.push(name.span().start().line);
        }
    }

    fn check_docs(
        &mut self,
        visibility: &syn::Visibility,
        attributes: &[syn::Attribute],
        line: usize,
    ) {
        let is_public = matches!(visibility, syn::Visibility::Public(_));
        if is_public && !attributes.iter().any(|attribute| attribute.path().is_ident("doc")) {
            self.undocumented.push(line);
        }
    }
}

impl<'ast> Visit<'ast> for Dialect {
    fn visit_item_fn(&mut self, item: &'ast syn::ItemFn) {
        self.check_name(&item.sig.ident);
        self.check_docs(&item.vis, &item.attrs, item.sig.span().start().line);
        visit::visit_item_fn(self, item);
    }

    fn visit_impl_item_fn(&mut self, item: &'ast syn::ImplItemFn) {
        self.check_name(&item.sig.ident);
        self.check_docs(&item.vis, &item.attrs, item.sig.span().start().line);
        visit::visit_impl_item_fn(self, item);
    }

    fn visit_trait_item_fn(&mut self, item: &'ast syn::TraitItemFn) {
        self.check_name(&item.sig.ident);
        visit::visit_trait_item_fn(self, item);
    }

    fn visit_item_struct(&mut self, item: &'ast syn::ItemStruct) {
        self.check_docs(&item.vis, &item.attrs, item.ident.span().start().line);
        visit::visit_item_struct(self, item);
    }

    fn visit_item_enum(&mut self, item: &'ast syn::ItemEnum) {
        self.check_docs(&item.vis, &item.attrs, item.ident.span().start().line);
        visit::visit_item_enum(self, item);
    }

    fn visit_item_trait(&mut self, item: &'ast syn::ItemTrait) {
        self.check_docs(&item.vis, &item.attrs, item.ident.span().start().line);
        visit::visit_item_trait(self, item);
    }

    fn visit_expr_match(&mut self, item: &'ast syn::ExprMatch) {
        let is_bool = |arm: &syn::Arm| match &arm.pat {
            syn::Pat::Lit(literal) => matches!(literal.lit, syn::Lit::Bool(_)),
            _ => false,
        };
        // An arm with a condition of its own is no `if`.
        if item.arms.iter().any(is_bool) && item.arms.iter().all(|arm| arm.guard.is_none()) {
            self.bool_matches.push(item.span().start().line);
        }
        visit::visit_expr_match(self, item);
    }

    fn visit_block(&mut self, block: &'ast syn::Block) {
        for pair in block.stmts.windows(2) {
            let [syn::Stmt::Local(first), syn::Stmt::Local(second)] = pair else { continue };
            if binding(first).is_some() && binding(first) == binding(second) {
                self.rebindings.push(second.span().start().line);
            }
        }
        visit::visit_block(self, block);
    }

    fn visit_local(&mut self, local: &'ast syn::Local) {
        let init = local.init.as_ref().map(|init| &*init.expr);
        let is_tuple = matches!(
            (&local.pat, init),
            (syn::Pat::Tuple(_), Some(syn::Expr::Tuple(_)))
                | (syn::Pat::Slice(_), Some(syn::Expr::Array(_)))
        );
        let line = local.span().start().line;
        if is_tuple {
            self.tuple_lets.push(line);
        }
        if let (Some(_), Some(syn::Expr::Closure(closure))) = (binding(local), init)
            && makes_error(&closure.body)
        {
            self.error_closures.push(line);
        }
        visit::visit_local(self, local);
    }
}

/// The name that a statement binds; `None` for a pattern.
fn binding(local: &syn::Local) -> Option<&syn::Ident> {
    match &local.pat {
        syn::Pat::Ident(name) => Some(&name.ident),
        _ => None,
    }
}

/// Whether the value of an expression is an error that is made on the spot.
fn makes_error(body: &syn::Expr) -> bool {
    let path = match body {
        syn::Expr::Struct(made) => &made.path,
        syn::Expr::Call(call) => match &*call.func {
            syn::Expr::Path(function) => &function.path,
            _ => return false,
        },
        syn::Expr::Block(block) => match block.block.stmts.last() {
            Some(syn::Stmt::Expr(last, None)) => return makes_error(last),
            _ => return false,
        },
        _ => return false,
    };
    path.segments.iter().any(|part| {
        let name = part.ident.to_string();
        name.ends_with("Error") || name.ends_with("Fault")
    })
}

/// Lines of a file by what is written in them.
#[derive(Default)]
struct Comments {
    plain: usize,
    short_docs: Vec<usize>,
    long: Vec<usize>,
}

impl Comments {
    fn read(text: &str) -> Self {
        let lines: Vec<&str> = text.lines().map(str::trim_start).collect();
        let is_doc = |at: Option<usize>| {
            at.and_then(|at| lines.get(at)).is_some_and(|line| line.starts_with("///"))
        };
        let mut comments = Self::default();
        for (at, line) in text.lines().enumerate() {
            let Some(words) = line.trim_start().strip_prefix("//") else { continue };
            // A row of a table and an address cannot be broken.
            let is_whole = words.contains(" | ") || words.contains("](") || words.contains("   ");
            if line.chars().count() > MOST_COLUMNS && !is_whole {
                comments.long.push(at + 1);
            }
            match words.strip_prefix('/') {
                Some(doc) => {
                    let is_alone = !is_doc(at.checked_sub(1)) && !is_doc(Some(at + 1));
                    if is_alone && doc.split_whitespace().count() <= 3 {
                        comments.short_docs.push(at + 1);
                    }
                }
                None => comments.plain += usize::from(!words.starts_with('!')),
            }
        }
        comments
    }
}

#[test]
fn the_source_has_no_dialect() {
    let mut lines = 0;
    let mut plain = 0;
    let mut rows = [
        ("functions of, x_of, of_x", 0),
        ("match on a boolean", 0),
        ("several bindings in a statement", BINDINGS),
        ("closures that only make an error", ERROR_CLOSURES),
        ("a name bound again by the next statement", REBINDINGS),
        ("public functions and types without a word", 0),
        ("documents of one to three words", SHORT_DOCS),
        ("comments over 100 columns", 0),
    ]
    .map(|(name, most)| Row { name, places: Vec::new(), most });
    for folder in PRODUCTION {
        for (file, text) in rust_files(&root().join(folder)) {
            let mut dialect = Dialect::read(&text);
            // Messages of AlpaSim, which are documented there.
            if file.starts_with("alpasim/wire/") {
                dialect.undocumented.clear();
            }
            let comments = Comments::read(&text);
            lines += text.lines().count();
            plain += comments.plain;
            let found = [
                dialect.names,
                dialect.bool_matches,
                dialect.tuple_lets,
                dialect.error_closures,
                dialect.rebindings,
                dialect.undocumented,
                comments.short_docs,
                comments.long,
            ];
            for (row, found) in rows.iter_mut().zip(found) {
                row.places.extend(found.iter().map(|line| format!("{folder}/{file}:{line}")));
            }
        }
    }
    eprintln!("{:52} {lines:>6}", "lines");
    eprintln!("{:52} {:>6.1} per cent", "plain comments", 100.0 * plain as f64 / lines as f64);
    rows.iter().for_each(|row| eprintln!("{row}"));
    let over = |row: &&Row| row.places.len() > row.most;
    let wrong: Vec<String> = rows
        .iter()
        .filter(over)
        .map(|row| format!("{row}\n  {}", row.places.join("\n  ")))
        .collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(plain * 1000 >= lines * PLAIN_PER_MILLE, "{plain} plain comments in {lines} lines");
}

#[test]
fn planted_dialect_is_found() {
    let text = "
        impl A {
            pub fn of_b(b: B) -> Self {
                let (x, y) = (1, 2);
                let [z, w] = [x, y];
                let failed = |source| AError::Io { source };
                let file = open();
                let file = read(file).map_err(failed)?;
                match file.is_good { true => z, false => w }
            }
        }
        /// A length.
        pub fn length_of(a: A) -> f64 { match a.x { true if a.y => 1.0, _ => 0.0 } }
        fn office() {}";
    let found = Dialect::read(text);
    assert_eq!(found.names, [3, 13]);
    assert_eq!(found.tuple_lets, [4, 5]);
    assert_eq!(found.error_closures, [6]);
    assert_eq!(found.rebindings, [8]);
    assert_eq!(found.bool_matches, [9]);
    assert_eq!(found.undocumented, [3]);
    let comments = Comments::read("//! a\n/// The name.\nfn f() {}\n// why\n/// A\n/// B\n");
    assert_eq!(comments.short_docs, [2]);
    assert_eq!(comments.plain, 1);
    let long = format!("// {}\n", "word ".repeat(20));
    assert_eq!(Comments::read(&long).long, [1]);
}
