//! The sources with a branch for each change.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use anyhow::{Context, Result};
use quote::ToTokens;
use syn::spanned::Spanned;
use syn::visit::{self, Visit};

use crate::list::{offset, Change, Genre};

/// What the library of the changed crate gets in addition: which change is on. `MUTANT` is its
/// number; or the name of a file, which then gets the numbers of all places that are reached.
pub const SWITCH: &str = r#"
#[doc(hidden)]
#[allow(missing_docs)]
pub mod mutant_switch {
    extern crate std;
    use core::sync::atomic::{AtomicBool, AtomicU32, Ordering::Relaxed};
    const UNKNOWN: u32 = u32::MAX;
    const NONE: u32 = u32::MAX - 1;
    const RECORD: u32 = u32::MAX - 2;
    static ON: AtomicU32 = AtomicU32::new(UNKNOWN);
    static REACHED: [AtomicBool; 1 << 14] = [const { AtomicBool::new(false) }; 1 << 14];
    #[inline(always)]
    pub fn on(number: u32) -> bool {
        match ON.load(Relaxed) {
            UNKNOWN => ask(number),
            RECORD => record(number),
            on => on == number,
        }
    }
    #[cold]
    #[inline(never)]
    fn ask(number: u32) -> bool {
        let told = std::env::var("MUTANT").unwrap_or_default();
        let on = told.parse().unwrap_or(if told.is_empty() { NONE } else { RECORD });
        ON.store(on, Relaxed);
        if on == RECORD {
            return record(number);
        }
        on == number
    }
    #[inline(never)]
    fn record(number: u32) -> bool {
        use std::io::Write;
        let is_new = REACHED.get(number as usize).is_none_or(|seen| !seen.swap(true, Relaxed));
        if is_new {
            let name = std::env::var_os("MUTANT").unwrap_or_default();
            let file = std::fs::OpenOptions::new().create(true).append(true).open(name);
            let line = std::format!("{number}\n");
            // One write: the lines of several threads do not mix.
            file.and_then(|mut file| file.write_all(line.as_bytes())).expect("the file can be written");
        }
        false
    }
}
"#;
/// The call of it.
const ON: &str = "crate::mutant_switch::on";

/// What is not to be changed.
#[derive(Debug, Default)]
pub struct Left {
    /// Changes that do not compile.
    pub changes: BTreeSet<usize>,
    /// The names of functions that have to stay `const`: a constant is made with them.
    pub constants: BTreeSet<String>,
}

/// A file with a branch for each of its changes, and the changes that became one.
///
/// # Errors
/// When the file is no Rust.
pub fn rewrite(text: &str, changes: &[(usize, &Change)], left: &Left) -> Result<(String, Vec<usize>)> {
    let file = syn::parse_file(text).context("syn cannot read it")?;
    let mut by_start = BTreeMap::<usize, Vec<(usize, &Change)>>::new();
    for (number, change) in changes.iter().filter(|(number, _)| !left.changes.contains(number)) {
        by_start.entry(offset(text, change.span.start)).or_default().push((*number, change));
    }
    let mut finder =
        Finder { text, by_start, left, constant: 0, has_rest: false, edits: Vec::new(), active: Vec::new() };
    finder.visit_file(&file);
    let all: Vec<usize> = (0..finder.edits.len()).collect();
    let new = written(text, &finder.edits, &all, 0..text.len());
    Ok((new, finder.active))
}

/// The number of the change whose branch in a rewritten file holds this place.
pub fn change_at(text: &str, at: usize) -> Option<usize> {
    let before = text.get(..at)?;
    let start = before.rfind("/*M")?;
    let number = text[start + 3..].split("*/").next()?.parse().ok()?;
    let end = start + text[start..].find("/*E*/")?;
    (at <= end).then_some(number)
}

/// The marks around the text of a change, by which an error of the compiler finds it.
fn marked(number: usize, text: &str) -> String {
    format!("/*M{number}*/{text}/*E*/")
}

/// New text in the place of a range.
struct Edit {
    range: Range<usize>,
    kind: Kind,
}

enum Kind {
    /// This text.
    Text(String),
    /// Another operator.
    Binary { left: Range<usize>, operator: Range<usize>, right: Range<usize>, changes: Vec<(usize, String)> },
    /// No operator.
    Unary { operand: Range<usize>, number: usize },
    /// The guard of an arm, and the change that leaves the arm out.
    Guard { changes: Vec<(usize, String)>, without: Option<usize> },
}

/// A range of the text with the edits in it, the outer ones first.
fn written(text: &str, edits: &[Edit], which: &[usize], range: Range<usize>) -> String {
    let mut inside: Vec<usize> = which
        .iter()
        .copied()
        .filter(|edit| edits[*edit].range.start >= range.start && edits[*edit].range.end <= range.end)
        .collect();
    inside.sort_by_key(|edit| (edits[*edit].range.start, usize::MAX - edits[*edit].range.end, *edit));
    let (mut new, mut at) = (String::new(), range.start);
    for edit in &inside {
        let Edit { range, kind } = &edits[*edit];
        if range.start < at {
            continue;
        }
        let others: Vec<usize> = inside.iter().copied().filter(|other| other != edit).collect();
        let nested = |range: &Range<usize>| written(text, edits, &others, range.clone());
        let plain = |range: &Range<usize>| &text[range.clone()];
        new += &text[at..range.start];
        match kind {
            Kind::Text(replaced) => new += replaced,
            Kind::Binary { left, operator, right, changes } => {
                new += "(";
                for (number, other) in changes {
                    let changed = marked(*number, &format!("({}) {other} ({})", plain(left), plain(right)));
                    new += &format!("if {ON}({number}) {{ {changed} }} else ");
                }
                new += &format!("{{ ({}) {} ({}) }})", nested(left), plain(operator), nested(right));
            }
            Kind::Unary { operand, number } => {
                let changed = marked(*number, plain(operand));
                let operator = &text[range.start..operand.start];
                new +=
                    &format!("(if {ON}({number}) {{ {changed} }} else {{ {operator}{} }})", nested(operand));
            }
            Kind::Guard { changes, without } => {
                let mut guard = format!("({})", nested(range));
                for (number, other) in changes {
                    guard = match other.as_str() {
                        "true" => format!("({ON}({number}) || {guard})"),
                        _ => format!("(!{ON}({number}) && {guard})"),
                    };
                }
                if let Some(number) = without {
                    guard = format!("(!{ON}({number}) && {guard})");
                }
                new += &guard;
            }
        }
        at = range.end;
    }
    new + &text[at..range.end]
}

/// Finds the places of the changes.
struct Finder<'a> {
    text: &'a str,
    /// The changes, by where their text starts.
    by_start: BTreeMap<usize, Vec<(usize, &'a Change)>>,
    left: &'a Left,
    /// How many constants the present place is in.
    constant: usize,
    /// Whether the present match has an arm for everything: then another arm may have a condition.
    has_rest: bool,
    edits: Vec<Edit>,
    active: Vec<usize>,
}

impl<'a> Finder<'a> {
    /// The changes of a kind at this place, which become branches now.
    fn take(&mut self, at: usize, is_it: impl Fn(&Change) -> bool) -> Vec<(usize, &'a Change)> {
        if self.constant > 0 {
            return Vec::new();
        }
        let there = self.by_start.get(&at).into_iter().flatten().copied();
        let taken: Vec<_> = there.filter(|(_, change)| is_it(change)).collect();
        self.active.extend(taken.iter().map(|(number, _)| number));
        taken
    }

    fn function(&mut self, signature: &syn::Signature, block: &syn::Block) {
        let stays = signature.constness.is_some_and(|word| {
            let stays = self.left.constants.contains(&signature.ident.to_string());
            if !stays {
                // A branch asks the environment, which no constant can.
                let kind = Kind::Text(String::new());
                self.edits.push(Edit { range: word.span().byte_range(), kind });
            }
            stays
        });
        self.constant += usize::from(stays);
        if let Some(first) = block.stmts.first() {
            let body = block.span().byte_range();
            let text = self.text;
            let is_its = |change: &Change| {
                let end = change.function.as_ref().map(|function| offset(text, function.span.end));
                change.genre == Genre::FnValue && end == Some(body.end)
            };
            let changes = self.take(first.span().byte_range().start, is_its);
            if !changes.is_empty() {
                let mut start = String::from("{");
                for (number, change) in changes {
                    let value = marked(number, &format!("return {};", change.replacement));
                    start += &format!(" if {ON}({number}) {{ {value} }}");
                }
                self.edits.push(Edit { range: body.start..body.start + 1, kind: Kind::Text(start) });
            }
        }
        visit::visit_block(self, block);
        self.constant -= usize::from(stays);
    }

    /// Visits what is evaluated when it is compiled.
    fn constant(&mut self, visit: impl FnOnce(&mut Self)) {
        self.constant += 1;
        visit(self);
        self.constant -= 1;
    }
}

/// Whether an item is for tests alone.
fn is_test(attributes: &[syn::Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        let meta = attribute.meta.to_token_stream().to_string();
        meta == "test" || meta.contains("cfg (test)")
    })
}

fn named(changes: &[(usize, &Change)]) -> Vec<(usize, String)> {
    changes.iter().map(|(number, change)| (*number, change.replacement.clone())).collect()
}

impl<'ast> Visit<'ast> for Finder<'_> {
    fn visit_item_fn(&mut self, item: &'ast syn::ItemFn) {
        if !is_test(&item.attrs) {
            self.function(&item.sig, &item.block);
        }
    }

    fn visit_impl_item_fn(&mut self, item: &'ast syn::ImplItemFn) {
        self.function(&item.sig, &item.block);
    }

    fn visit_trait_item_fn(&mut self, item: &'ast syn::TraitItemFn) {
        if let Some(block) = &item.default {
            self.function(&item.sig, block);
        }
    }

    fn visit_item_mod(&mut self, item: &'ast syn::ItemMod) {
        if !is_test(&item.attrs) {
            visit::visit_item_mod(self, item);
        }
    }

    fn visit_item_const(&mut self, item: &'ast syn::ItemConst) {
        self.constant(|this| visit::visit_item_const(this, item));
    }

    fn visit_impl_item_const(&mut self, item: &'ast syn::ImplItemConst) {
        self.constant(|this| visit::visit_impl_item_const(this, item));
    }

    fn visit_trait_item_const(&mut self, item: &'ast syn::TraitItemConst) {
        self.constant(|this| visit::visit_trait_item_const(this, item));
    }

    fn visit_item_static(&mut self, item: &'ast syn::ItemStatic) {
        self.constant(|this| visit::visit_item_static(this, item));
    }

    fn visit_item_enum(&mut self, item: &'ast syn::ItemEnum) {
        self.constant(|this| visit::visit_item_enum(this, item));
    }

    fn visit_type(&mut self, of: &'ast syn::Type) {
        self.constant(|this| visit::visit_type(this, of));
    }

    fn visit_expr_const(&mut self, expression: &'ast syn::ExprConst) {
        self.constant(|this| visit::visit_expr_const(this, expression));
    }

    fn visit_generic_argument(&mut self, argument: &'ast syn::GenericArgument) {
        self.constant(|this| visit::visit_generic_argument(this, argument));
    }

    fn visit_expr_repeat(&mut self, expression: &'ast syn::ExprRepeat) {
        self.visit_expr(&expression.expr);
        self.constant(|this| this.visit_expr(&expression.len));
    }

    fn visit_pat(&mut self, pattern: &'ast syn::Pat) {
        self.constant(|this| visit::visit_pat(this, pattern));
    }

    fn visit_expr_binary(&mut self, expression: &'ast syn::ExprBinary) {
        let operator = expression.op.span().byte_range();
        let changes = self.take(operator.start, |change| change.genre == Genre::BinaryOperator);
        if !changes.is_empty() {
            let (left, right) = (expression.left.span().byte_range(), expression.right.span().byte_range());
            let kind = Kind::Binary { left, operator, right, changes: named(&changes) };
            self.edits.push(Edit { range: expression.span().byte_range(), kind });
        }
        visit::visit_expr_binary(self, expression);
    }

    fn visit_expr_unary(&mut self, expression: &'ast syn::ExprUnary) {
        let start = expression.op.span().byte_range().start;
        if let [(number, _), ..] = self.take(start, |change| change.genre == Genre::UnaryOperator)[..] {
            let kind = Kind::Unary { operand: expression.expr.span().byte_range(), number };
            self.edits.push(Edit { range: expression.span().byte_range(), kind });
        }
        visit::visit_expr_unary(self, expression);
    }

    fn visit_expr_match(&mut self, expression: &'ast syn::ExprMatch) {
        self.visit_expr(&expression.expr);
        let is_rest = |arm: &syn::Arm| arm.guard.is_none() && matches!(arm.pat, syn::Pat::Wild(_));
        let has_rest = expression.arms.iter().any(is_rest);
        for arm in &expression.arms {
            self.has_rest = has_rest;
            self.visit_arm(arm);
        }
    }

    fn visit_arm(&mut self, arm: &'ast syn::Arm) {
        let is_let = matches!(arm.guard.as_ref().map(|(_, guard)| &**guard), Some(syn::Expr::Let(_)));
        let start = arm.span().byte_range().start;
        let can_go = self.has_rest && !is_let;
        let without =
            if can_go { self.take(start, |change| change.genre == Genre::MatchArm) } else { Vec::new() };
        let without = without.first().map(|(number, _)| *number);
        match &arm.guard {
            Some((_, guard)) if !is_let => {
                let range = guard.span().byte_range();
                let changes = self.take(range.start, |change| change.genre == Genre::MatchArmGuard);
                if !changes.is_empty() || without.is_some() {
                    let kind = Kind::Guard { changes: named(&changes), without };
                    self.edits.push(Edit { range, kind });
                }
                self.visit_expr(guard);
            }
            _ => {
                if let Some(number) = without {
                    let end = arm.pat.span().byte_range().end;
                    let kind = Kind::Text(format!(" if !{ON}({number})"));
                    self.edits.push(Edit { range: end..end, kind });
                }
            }
        }
        self.visit_expr(&arm.body);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::list::{Function, Place, Span};

    /// The place of a text in another.
    fn span(text: &str, part: &str) -> Span {
        let start = text.find(part).unwrap();
        let place = |at: usize| {
            let line = text[..at].matches('\n').count() + 1;
            let column = at - text[..at].rfind('\n').map_or(0, |end| end + 1) + 1;
            Place { line, column }
        };
        Span { start: place(start), end: place(start + part.len()) }
    }

    fn change(text: &str, part: &str, replacement: &str, genre: Genre) -> Change {
        let whole = text.trim_end();
        let function = Some(Function { span: span(text, whole) });
        Change {
            name: String::new(),
            file: String::new(),
            function,
            span: span(text, part),
            replacement: replacement.into(),
            genre,
        }
    }

    fn rewritten(text: &str, changes: &[Change], left: &Left) -> (String, Vec<usize>) {
        let numbered: Vec<_> = changes.iter().enumerate().collect();
        let (new, active) = rewrite(text, &numbered, left).unwrap();
        syn::parse_file(&new).unwrap_or_else(|error| panic!("{error}: {new}"));
        (new, active)
    }

    #[test]
    fn operators_within_operators_become_branches() {
        let text = "fn f(a: u32, b: u32) -> bool { !(a + b < 3) }\n";
        let changes = [
            change(text, "+", "-", Genre::BinaryOperator),
            change(text, "<", "<=", Genre::BinaryOperator),
            change(text, "!", "", Genre::UnaryOperator),
            change(text, "!(a", "true", Genre::FnValue),
        ];
        let (new, active) = rewritten(text, &changes, &Left::default());
        assert_eq!(active.len(), 4);
        for number in 0..4 {
            assert_eq!(new.matches(&format!("{ON}({number})")).count(), 1, "{new}");
            let at = new.find(&format!("/*M{number}*/")).unwrap() + 8;
            assert_eq!(change_at(&new, at), Some(number));
        }
        assert_eq!(change_at(&new, 3), None);
    }

    #[test]
    fn arms_and_guards_become_conditions() {
        let text = "fn f(a: u8) -> u8 { match a { 1 => 2, x if x > 7 => 3, _ => 4 } }\n";
        let changes = [
            change(text, "1 => 2", "", Genre::MatchArm),
            change(text, "x > 7", "true", Genre::MatchArmGuard),
            change(text, "x > 7", "false", Genre::MatchArmGuard),
            change(text, ">", "<", Genre::BinaryOperator),
        ];
        // The first ">" of the text is that of the arrow.
        let mut changes = changes;
        changes[3].span = span(text, "> 7");
        let (new, active) = rewritten(text, &changes, &Left::default());
        assert_eq!(active.len(), 4, "{new}");
        assert!(new.contains(&format!("1 if !{ON}(0) => 2")), "{new}");
        assert!(new.contains(&format!("!{ON}(2) && ({ON}(1) || (")), "{new}");
    }

    #[test]
    fn an_arm_stays_where_no_other_takes_its_place() {
        let text = "fn f(a: bool) -> u8 { match a { true => 2, false => 3 } }\n";
        assert!(rewritten(text, &[change(text, "true => 2", "", Genre::MatchArm)], &Left::default())
            .1
            .is_empty());
    }

    #[test]
    fn a_constant_is_left_alone_and_a_function_that_makes_one_too() {
        let text = "const A: u8 = 1 + 2;\n";
        assert_eq!(
            rewritten(text, &[change(text, "+", "-", Genre::BinaryOperator)], &Left::default()).1,
            Vec::<usize>::new()
        );
        let text = "const fn f(a: u8) -> u8 { a + 2 }\n";
        let changes = [change(text, "+", "-", Genre::BinaryOperator)];
        let (new, active) = rewritten(text, &changes, &Left::default());
        assert!(active == [0] && !new.contains("const"), "{new}");
        let stays = Left { constants: BTreeSet::from(["f".to_owned()]), ..Left::default() };
        assert_eq!(rewritten(text, &changes, &stays), (text.to_owned(), vec![]));
        let without = Left { changes: BTreeSet::from([0]), ..Left::default() };
        assert_eq!(rewritten(text, &changes, &without).1, Vec::<usize>::new());
    }
}
