//! The commands on the pages of the documentation, read by the command line's own parser.

use clap::Parser;
use coboot_node::args::Args;
use kit::pages;

/// Every call of this program on every page is parsed by the command line's own parser.
#[test]
fn what_the_pages_show_is_understood() {
    let mut count = 0;
    for shown in pages::commands() {
        let Some(words) = pages::call_of(&shown.words, "coboot-node") else { continue };
        count += 1;
        let words = std::iter::once("coboot-node").chain(words.iter().map(String::as_str));
        if let Err(error) = Args::try_parse_from(words) {
            panic!("{}: {:?}: {error}", shown.place, shown.words);
        }
    }
    assert!(count > 0);
}
