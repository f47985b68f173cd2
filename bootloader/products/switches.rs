//! For the tests: nearly every other choice differs from its default. The pins of port E give node-ID
//! and bit rate; PC0 is high if a program may be started.

use super::*;

/// The choices of this product.
pub const PRODUCT: Product = Product {
    node_source: NodeSource::Function(|| {
        // Seven switches for the node-ID, four for the bit rate.
        let switches = bsp::inputs('E');
        ((switches >> 8) as u8 & 0x7F, (switches >> 4) as u8 & 0xF)
    }),
    start_allowed: |_| bsp::inputs('C') & 1 != 0,
    node_ids: 2..=100,
    bit_rates: 2..=6,
    boot_up_message: false,
    boot_up_emergency: false,
    sdo_request_base: 0x300,
    sdo_response_base: 0x480,
    segments_per_sub_block: 20,
    receive_queue: 8,
    lss_start_in_configuration: true,
    lss_announce: true,
    lss_store: false,
    identity: IdentitySource::Otp,
    erase: Some(|_| Erase::AtOnce),
    ..Product::DEFAULT
};
