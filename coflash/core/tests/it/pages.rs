//! The examples of the documentation, and the sheets of the product, are what the library reads.

use std::path::Path;

use canopen::{Address, NodeId};
use coflash_core::device::eds::Eds;
use coflash_core::device::value::DataType;
use coflash_core::update::job;

#[test]
fn the_pages_example_is_a_job() {
    let page = include_str!("../../../../docs/coflash.md");
    let mut blocks = page.split("```toml\n").skip(1).filter_map(|block| block.split("```").next());
    let example = blocks.find(|block| block.contains("[[device]]")).unwrap();
    let entries = job::parse(example, Path::new("folder")).unwrap();
    let nodes: Vec<_> = entries.iter().filter_map(|entry| entry.node).map(NodeId::get).collect();
    assert_eq!(nodes, [5, 6, 9]);
    assert_eq!((entries[1].settings.start, entries[0].settings.trial_run), (Some(false), Some(true)));
    assert!(entries[2].address.is_some());
}

#[test]
fn the_sheets_of_the_product_are_understood() {
    let eds = Eds::parse(include_bytes!("../../../../docs/eds/coboot-bootloader.eds")).unwrap();
    let control = eds.find("Program control/1").unwrap();
    assert_eq!((control.at, control.kind), (Address::new(0x1F51, 1), Some(DataType::Unsigned(1))));
}
