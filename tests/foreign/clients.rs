//! Foreign programs, unmodified, against the emulated device through the socketcand endpoint.

use canopen::BitRate;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::endpoint::Endpoint;
use coboot_tests::firmware;
use coboot_tests::tools::{script, text};
use coflash_core::file::block_file::emit;

const VERSION: u16 = 0x100A;

fn endpoint() -> Endpoint {
    let bench = Bench::new().switched_on();
    Endpoint::new(bench)
}

#[test]
fn python_canopen_identifies_flashes_and_starts_the_device() {
    let mut endpoint = endpoint();
    let folder = kit::folder!("clients");
    let file = folder.write("program.blk", emit(&firmware::blocks(firmware::APP_V1)));
    let said = endpoint.succeed(script("canopen_client.py").arg(endpoint.address()).arg(file));
    let bsp::Identity { vendor_id, product_code, revision, .. } = bsp::IDENTITY;
    for line in [
        "1000h device type = 10000000h",
        &format!("1018h vendor {vendor_id:08X}h, product {product_code:08X}h, revision {revision:08X}h"),
        "1F57h flash status = 00000000h",
        "cleared",
        "signed",
        "the application reports 1F51h = 01h and the same 1F56h",
    ] {
        assert!(said.contains(line), "no {line:?} in:\n{said}");
    }
    assert_eq!(endpoint.bench.text(VERSION), "1.0.0");
    endpoint.bench.assert_nothing_unmodelled();
}

/// A foreign master: a raw image in segments into an empty device, and by block transfer into a
/// device with a running program.
#[test]
fn python_canopen_updates_the_device_by_raw_images() {
    let folder = kit::folder!("clients");
    let mut endpoint = endpoint();
    for (image, option, version) in
        [(firmware::APP_V1, None, "1.0.0"), (firmware::APP_V2, Some("--block"), "2.0.0")]
    {
        let path = folder.write(format!("{image}.bin"), firmware::raw(image));
        let mut client = script("image_client.py");
        let said = endpoint.succeed(client.arg(endpoint.address()).arg(path).args(option));
        assert!(said.contains("started; 1F56h is the same"), "{said}");
        assert_eq!(endpoint.bench.text(VERSION), version);
    }
    // A machine that moves is left alone, and its program stays.
    endpoint.bench.move_machine(firmware::APP_V2, true);
    let path = folder.write("again.bin", firmware::raw(firmware::APP_V1));
    let output = endpoint.run(script("image_client.py").arg(endpoint.address()).arg(path));
    assert!(!output.status.success() && text(&output).contains("08000022"), "{}", text(&output));
    endpoint.bench.run_ms(700);
    assert_eq!(endpoint.bench.text(VERSION), "2.0.0");
    endpoint.bench.assert_nothing_unmodelled();
}

/// Bootloader and application; python-canopen uses no protocol switch threshold. Clients with one, like
/// CANopenNode: `core/canopen/tests/it/block.rs` and `tests/update/choices.rs`.
#[test]
#[cfg_attr(not(split_map), ignore = "needs the split map")]
fn python_canopen_reads_objects_by_block_upload() {
    let bootloader = Bench::new().switched_on();
    for bench in [bootloader, Bench::running(BitRate::K125, firmware::APP_V1)] {
        let mut endpoint = Endpoint::new(bench);
        let mut client = script("block_upload_client.py");
        let said = endpoint.succeed(client.arg(endpoint.address()).arg(NODE.to_string()));
        let name: String = bsp::IDENTITY.device_name.bytes().map(|byte| format!("{byte:02x}")).collect();
        assert!(said.contains(&format!("1008h/0: {name}\n")), "{said}");
        endpoint.bench.assert_nothing_unmodelled();
    }
}

/// The asyncio port of the same client, with its own calls: in segments, with an SDO time-out of 2
/// s.
#[test]
fn canopen_asyncio_updates_the_device_by_raw_images() {
    let folder = kit::folder!("clients");
    let mut endpoint = endpoint();
    for (image, stopped, version) in [(firmware::APP_V1, false, "1.0.0"), (firmware::APP_V2, true, "2.0.0")] {
        let path = folder.write(format!("{image}.bin"), firmware::raw(image));
        let mut client = script("asyncio_client.py");
        let said = endpoint.succeed(client.arg(endpoint.address()).arg(path).arg("1"));
        assert_eq!(said.contains("node 1: stopped"), stopped, "{said}");
        assert!(said.contains("node 1: started; 1F56h is the same"), "{said}");
        assert_eq!(endpoint.bench.text(VERSION), version);
    }
    endpoint.bench.assert_nothing_unmodelled();
}

/// Each public script with its own time-outs, on a board that runs so much slower than real time. From the running
/// program, twice in a row.
#[test]
fn public_scripts_update_the_device_twice_in_a_row() {
    const SLOWER: u32 = 2;
    let folder = kit::folder!("clients");
    for order in ["ixxat", "mcuboot", "ulc", "emotas", "ddt", "issue28"] {
        let mut endpoint = Endpoint::slower(Bench::running(BitRate::K500, firmware::APP_V1), SLOWER);
        for (image, version) in [(firmware::APP_V2, "2.0.0"), (firmware::APP_V1, "1.0.0")] {
            let path = folder.write(format!("{image}.bin"), firmware::raw(image));
            let mut client = script("script_client.py");
            client.arg(endpoint.address()).arg(path).arg(order).args(["--slower", &SLOWER.to_string()]);
            println!("{order}: {}", endpoint.succeed(&mut client));
            assert_eq!(endpoint.bench.text(VERSION), version, "{order}");
        }
        endpoint.bench.assert_nothing_unmodelled();
    }
}
