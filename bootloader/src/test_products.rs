//! The products that this repository builds for its tests, in addition to the one in `product.rs`:
//! one for each dialect, and choices that tests need. `COBOOT_PRODUCT` in the environment of a
//! build names one. A real product does not need this file.

use super::{CrcKind, Erase, NodeSource, Product, Profile, Verdict};

/// The product that the build names; `this` if it names none.
pub const fn or_this(this: Product) -> Product {
    match option_env!("COBOOT_PRODUCT") {
        None => this,
        Some(name) if name.as_bytes()[0] == b':' => of_choices(this, name.as_bytes()),
        Some(name) => named(this, name),
    }
}

/// The product with this name.
const fn named(this: Product, name: &str) -> Product {
    if equal(name, "paulus") {
        Product { profile: Profile::PAULUS, ..this }
    } else if equal(name, "esacademy") {
        Product { profile: Profile::ESACADEMY, ..this }
    } else if equal(name, "lift") {
        Product { profile: Profile::LIFT, ..this }
    } else if equal(name, "crc-16") {
        // The step is so large that the tests see the cost of a long computation.
        Product { crc: CrcKind::Crc16, crc_step: 64 * 1024, ..this }
    } else if equal(name, "least") {
        Product {
            rescue_window_ms: 0,
            auto_bit_rate: false,
            boot_up_emergency: false,
            watchdog_ms: None,
            lss: false,
            block_upload: false,
            second_server: false,
            resume: false,
            ..this
        }
    } else if equal(name, "switches") {
        // The pins of port E give node-ID and bit rate, PC0 tells whether a program may be started,
        // and nearly every other choice differs from its default.
        Product {
            node_source: SWITCHES,
            start_allowed: |_| bsp::inputs('C') & 1 != 0,
            node_ids: 2..=100,
            bit_rates: 2..=6,
            boot_up_message: false,
            boot_up_emergency: false,
            sdo_request_base: 0x680,
            sdo_response_base: 0x480,
            lss_start_in_configuration: true,
            lss_announce: true,
            lss_store: false,
            erase: Some(|_| Erase::AtOnce),
            ..this
        }
    } else {
        panic!(
            "COBOOT_PRODUCT: it must be paulus, esacademy, lift, crc-16, least, switches or a row of choices"
        )
    }
}

/// Seven switches for the node-ID, four for the bit rate.
const SWITCHES: NodeSource = NodeSource::Function(|| {
    let switches = bsp::inputs('E');
    ((switches >> 8) as u8 & 0x7F, (switches >> 4) as u8 & 0xF)
});

/// The product of a row of choices: a colon, then a digit for each field. `cargo xtask pairs` makes
/// the rows; it has the same fields in the same order. A digit without a meaning fails the build.
const fn of_choices(this: Product, row: &[u8]) -> Product {
    assert!(row.len() == 35, "COBOOT_PRODUCT: a row has a colon and 34 digits");
    Product {
        profile: match row[1] {
            b'0' => Profile::STANDARD,
            b'1' => Profile::PAULUS,
            b'2' => Profile::ESACADEMY,
            b'3' => Profile::LIFT,
            _ => no_such_choice(),
        },
        autostart: if second(row, 2) { None } else { Some(1) },
        rescue_window_ms: if second(row, 3) { 0 } else { 300 },
        rescue_window_confirmed_ms: if second(row, 4) { 100 } else { 0 },
        node_ids: if second(row, 5) { 2..=100 } else { 1..=127 },
        bit_rates: if second(row, 6) { 2..=6 } else { 0..=8 },
        node_source: match row[7] {
            b'0' => NodeSource::Stored,
            b'1' => NodeSource::Constant,
            b'2' => SWITCHES,
            _ => no_such_choice(),
        },
        boot_up_message: !second(row, 8),
        sdo_request_base: if second(row, 9) { 0x680 } else { 0x600 },
        sdo_response_base: if second(row, 10) { 0x480 } else { 0x580 },
        auto_bit_rate: !second(row, 11),
        boot_up_emergency: !second(row, 12),
        heartbeat_ms: if second(row, 13) { 0 } else { 1000 },
        lss: !second(row, 14),
        lss_start_in_configuration: second(row, 15),
        lss_announce: second(row, 16),
        lss_store: !second(row, 17),
        block_upload: !second(row, 18),
        identity_check: !second(row, 19),
        check: if second(row, 20) { |_, _| Verdict::Accept } else { |_, _| Verdict::Standard },
        programming_allowed: if second(row, 21) { || bsp::inputs('C') & 2 != 0 } else { || true },
        erase: if second(row, 22) { Some(|_| Erase::AtOnce) } else { None },
        start_allowed: if second(row, 23) { |_| bsp::inputs('C') & 1 != 0 } else { |_| true },
        crc: if second(row, 24) { CrcKind::Crc16 } else { CrcKind::Crc32 },
        crc_step: if second(row, 25) { 64 * 1024 } else { 1024 },
        block_buffer: if second(row, 26) { 1024 } else { this.block_buffer },
        watchdog_ms: if second(row, 27) { None } else { Some(1000) },
        program_watchdog_ms: if second(row, 28) { Some(1000) } else { None },
        answer_to_reset_ms: if second(row, 29) { 50 } else { 20 },
        max_crash_resets: if second(row, 30) { 1 } else { 3 },
        // Without the feature `sealed` these two have no effect.
        security_counter: if second(row, 31) { 5 } else { 0 },
        counter_with_confirmation: second(row, 32),
        second_server: !second(row, 33),
        resume: !second(row, 34),
    }
}

/// Whether the second of two values is chosen.
const fn second(row: &[u8], field: usize) -> bool {
    match row[field] {
        b'0' => false,
        b'1' => true,
        _ => no_such_choice(),
    }
}

const fn no_such_choice() -> ! {
    panic!("COBOOT_PRODUCT: a digit of the row stands for no value of its field")
}

const fn equal(a: &str, b: &str) -> bool {
    let (a, b) = (a.as_bytes(), b.as_bytes());
    if a.len() != b.len() {
        return false;
    }
    let mut i = 0;
    while i < a.len() {
        if a[i] != b[i] {
            return false;
        }
        i += 1;
    }
    true
}
