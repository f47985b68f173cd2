//! An unmodified python-canopen writes sealed images to the emulated device, in real time.

use std::env;
use std::path::Path;
use std::process::{Command, Output};

use canopen::program::ProgramControl;
use coboot_tests::bench::Bench;
use coboot_tests::endpoint::Endpoint;
use coboot_tests::firmware;
use coboot_tests::sealed_board::{board, seal, sealer, COUNTER, KEKS};
use coflash_core::file::sealed::Sealer;

/// How many times slower than real time the board runs for a client with its own time-out, and how many
/// times longer that time-out is: their ratio stays, and a busy host has time enough.
const SLOWER: u32 = 4;

fn started() -> Bench {
    board().switched_on()
}

/// By either transfer; an image with a flipped bit is refused. The time-out is long, because it
/// uses the clock of a possibly busy machine.
#[test]
fn an_unmodified_python_canopen_writes_a_sealed_image() {
    let mut endpoint = Endpoint::new(started());
    let genuine = Sealer { compress: true, ..sealer(COUNTER) };
    let genuine = seal(&genuine, firmware::APP_V1);
    let mut flipped = genuine.clone();
    flipped[50] ^= 1;
    for (way, file, said) in [
        (None, &flipped, "1F57h = 0000008Ah"),
        (Some("--block"), &genuine, "started"),
        (None, &genuine, "started"),
    ] {
        let output = python_canopen(&mut endpoint, "app.cbs", file, way.as_slice());
        // A bad signature slows the device down for half a second.
        endpoint.bench.run_ms(1000);
        let text = [output.stdout, output.stderr].concat();
        let text = String::from_utf8_lossy(&text);
        assert!(text.contains(said), "{way:?}: {text}");
        if said == "started" {
            assert!(output.status.success(), "{text}");
            assert_eq!(endpoint.bench.text(0x100A), "1.0.0");
            endpoint.bench.session().command(1, ProgramControl::Stop).unwrap();
            endpoint.bench.run_ms(100);
        }
    }
    endpoint.bench.assert_nothing_unmodelled();
}

/// The client with its defaults: its own SDO time-out of 0.3 s, its own block size.
#[test]
fn a_python_canopen_as_it_comes_writes_a_sealed_image_by_block_transfer() {
    let mut endpoint = Endpoint::slower(started(), SLOWER);
    let genuine = Sealer { encrypt_for: &*KEKS, compress: true, ..sealer(COUNTER) };
    let genuine = seal(&genuine, firmware::APP_V1);
    let factor = SLOWER.to_string();
    let ways = ["--block", "--as-it-comes", &factor];
    let output = python_canopen(&mut endpoint, "as-it-comes.cbs", &genuine, &ways);
    let said = [output.stdout, output.stderr].concat();
    let said = String::from_utf8_lossy(&said);
    assert!(output.status.success() && said.contains("started\n"), "{said}");
    assert_eq!(endpoint.bench.text(0x100A), "1.0.0");
    endpoint.bench.assert_nothing_unmodelled();
}

/// Makes python-canopen write these bytes from a file with this name.
fn python_canopen(endpoint: &mut Endpoint, name: &str, bytes: &[u8], ways: &[&str]) -> Output {
    let python = env::var_os("COBOOT_PYTHON")
        .unwrap_or_else(|| panic!("COBOOT_PYTHON is not set: run the tests by `cargo xtask test`"));
    let folder = kit::folder!("client");
    let path = folder.write(name, bytes);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/sealed_client.py");
    endpoint.run(Command::new(python).arg(script).arg(endpoint.address()).arg(path).args(ways))
}
