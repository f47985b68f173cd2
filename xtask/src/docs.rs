//! What the documents quote, held against what they quote from.

use std::fs;

use crate::workspace;

/// A block of code in a document that names the file it was taken from.
struct Quote {
    file: String,
    lines: Vec<String>,
}

/// The marker in front of a quoted block: `<!-- from FILE -->`, a fence behind it.
const MARKER: &str = "<!-- from ";
/// A line that stands for some that were left out.
const GAP: &str = "// …";

/// Lines as they are compared: without their indentation, and without the empty ones.
fn bare(text: &str) -> Vec<String> {
    text.lines().map(|line| line.trim().to_owned()).filter(|line| !line.is_empty()).collect()
}

fn quotes(document: &str) -> Vec<Quote> {
    let quote = |behind: &str| {
        let (file, rest) = behind.split_once(" -->").expect("a marker ends with -->");
        let (_, rest) = rest.split_once("```").expect("code follows a marker");
        let (block, _) = rest.split_once("```").expect("the code ends");
        let (_language, code) = block.split_once('\n').expect("the code has lines");
        Quote { file: file.to_owned(), lines: bare(code) }
    };
    document.split(MARKER).skip(1).map(quote).collect()
}

/// The first part of the quote that does not stand in the source, in one piece and behind the part
/// before.
fn missing(quote: &[String], source: &str) -> Option<String> {
    let source = bare(source);
    let mut rest = source.as_slice();
    for part in quote.split(|line| line == GAP) {
        match rest.windows(part.len()).position(|window| window == part) {
            Some(at) => rest = &rest[at + part.len()..],
            None => return Some(part.join("\n")),
        }
    }
    None
}

#[test]
fn the_guides_show_code_as_it_is() {
    let root = workspace::root();
    for (document, least) in [("docs/application.md", 10)] {
        let found = quotes(&fs::read_to_string(root.join(document)).unwrap());
        assert!(found.len() >= least, "{document}: {} quotes", found.len());
        for Quote { file, lines } in found {
            let source = fs::read_to_string(root.join(&file)).expect(&file);
            let gone = missing(&lines, &source);
            assert_eq!(gone, None, "{document} quotes what {file} does not have: copy it from there");
        }
    }
}

#[test]
fn a_quote_that_has_changed_is_found() {
    let source = "fn a() {\n    one();\n    two();\n    three();\n}\n";
    let quote = |code: &str| bare(code);
    assert_eq!(missing(&quote("one();\ntwo();"), source), None);
    assert_eq!(missing(&quote("one();\n// …\nthree();"), source), None);
    assert_eq!(missing(&quote("one();\nthree();"), source).as_deref(), Some("one();\nthree();"));
    assert_eq!(missing(&quote("three();\n// …\none();"), source).as_deref(), Some("one();"));
}

/// Every page and picture of the repository that a document refers to is there.
#[test]
fn links_between_the_documents_lead_somewhere() {
    let root = workspace::root();
    let mut pages = vec![root.join("README.md")];
    pages.extend(fs::read_dir(root.join("docs")).unwrap().map(|entry| entry.unwrap().path()));
    let mut links = 0;
    for page in pages.iter().filter(|page| page.extension().is_some_and(|extension| extension == "md")) {
        let text = fs::read_to_string(page).unwrap();
        for (_, behind) in text.match_indices("](").map(|(at, _)| text.split_at(at + 2)) {
            let (target, _) = behind.split_once(')').expect("a link ends");
            let (file, _) = target.split_once('#').unwrap_or((target, ""));
            if file.is_empty() || file.contains("://") {
                continue;
            }
            links += 1;
            assert!(page.with_file_name("").join(file).exists(), "{}: {target}", page.display());
        }
    }
    assert!(links > 10, "{links}");
}
