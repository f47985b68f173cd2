//! The sheets of the product are what the library reads.

use canopen::Address;
use coflash_core::device::eds::Eds;
use coflash_core::device::value::DataType;

#[test]
fn the_sheets_of_the_product_are_understood() {
    let eds = Eds::parse(include_bytes!("../../../../docs/eds/coboot-bootloader.eds")).unwrap();
    let control = eds.find("Program control/1").unwrap();
    assert_eq!((control.at, control.kind), (Address::new(0x1F51, 1), Some(DataType::Unsigned(1))));
}
