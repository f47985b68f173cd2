//! For the tests: nearly every other choice differs from its default. The pins of port E give node-ID
//! and bit rate; PC0 is high if a program may be started.

use super::*;

/// The choices of this product.
pub const PRODUCT: Product = Product {
    node: Node {
        source: NodeSource::Function(|| {
            // Seven switches for the node-ID, four for the bit rate.
            let switches = bsp::inputs('E');
            ((switches >> 8) as u8 & 0x7F, (switches >> 4) as u8 & 0xF)
        }),
        ids: 2..=100,
        bit_rates: 2..=6,
        ..Node::DEFAULT
    },
    nmt: Nmt { boot_up_message: false, boot_up_emergency: false, ..Nmt::DEFAULT },
    sdo: Sdo { request_base: 0x300, response_base: 0x480, receive_queue: 8, ..Sdo::DEFAULT },
    block_download: Some(BlockDownload { segments_per_sub_block: 20, ..BlockDownload::DEFAULT }),
    lss: Some(Lss { start_in_configuration: true, announce: true, store: false, ..Lss::DEFAULT }),
    identity: Identity { source: IdentitySource::Otp, ..Identity::DEFAULT },
    hooks: Hooks {
        erase: Some(|_| Erase::AtOnce),
        start_allowed: |_| bsp::inputs('C') & 1 != 0,
        ..Hooks::DEFAULT
    },
    ..Product::DEFAULT
};
