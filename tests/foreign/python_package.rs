//! The Python package (`coflash/python/`): its wheel is built and installed like a user's, its own tests
//! run against `coboot-node` over TCP, and it updates the emulated sealed board.

use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;
use std::time::Duration;
use std::{env, fs};

use canopen::program::ProgramControl;
use canopen::Address;
use coboot_tests::endpoint::Endpoint;
use coboot_tests::tools::{python, succeeded, text};
use coboot_tests::{firmware, sealed_board};
use kit::folder::Alone;

/// Runs a program to its end.
#[track_caller]
fn done(command: &mut Command) -> String {
    succeeded(&command.output().unwrap_or_else(|error| panic!("{command:?}: {error}")))
}

/// The only file in a folder.
fn only(folder: &Path) -> PathBuf {
    let files: Vec<_> = fs::read_dir(folder).unwrap().map(|file| file.unwrap().path()).collect();
    let [file] = files.as_slice() else { panic!("{files:?}") };
    file.clone()
}

/// The package as a user has it, in its own folder, until this process ends.
static PACKAGE: LazyLock<(PathBuf, Alone)> = LazyLock::new(|| {
    let installed = Path::new(env!("CARGO_TARGET_TMPDIR")).join("python-package");
    let alone = Alone::at(&installed.with_extension("lock"));
    let wheels = kit::folder!("python-wheels");
    let maturin = ["-m", "maturin", "build", "--profile", "dev", "--manifest-path"];
    done(python().args(maturin).arg(source().join("Cargo.toml")).arg("--out").arg(&*wheels));
    let wheel = only(&wheels);
    // One wheel for every Python from 3.9 on.
    let name = wheel.file_name().unwrap().to_string_lossy().into_owned();
    assert!(name.starts_with("coflash-") && name.contains("-cp39-abi3-"), "{name}");

    let _ = fs::remove_dir_all(&installed);
    let pip = ["-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target"];
    done(python().args(pip).arg(&installed).arg(&wheel));
    (installed, alone)
});

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap()
}

fn source() -> PathBuf {
    root().join("coflash/python")
}

/// A Python with the package.
fn with_package() -> Command {
    let mut python = python();
    python.current_dir(&PACKAGE.0).env("PYTHONPATH", &PACKAGE.0).env("PYTHONDONTWRITEBYTECODE", "1");
    python
}

#[test]
fn the_wheel_is_built_installed_and_passes_its_tests() {
    let cargo = env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let manifest = root().join("Cargo.toml");
    let build =
        ["build", "--quiet", "--package", "coboot-node", "--message-format", "json", "--manifest-path"];
    let said = done(Command::new(cargo).args(build).arg(manifest));
    let (_, node) = said.rsplit_once("\"executable\":\"").expect("cargo says where it is");
    let node = node.split('"').next().unwrap_or_default();

    let tests = ["-m", "pytest", "-q", "-p", "no:cacheprovider"];
    let said = done(with_package().args(tests).arg(source().join("tests")).env("COBOOT_NODE", node));
    assert!(said.contains(" passed") && !said.contains("skipped"), "{said}");
    the_pages_scripts_run(node);
}

/// The scripts of the pages, as printed but for the bus, on a node with their node-ID.
fn the_pages_scripts_run(node: &str) {
    let folder = kit::folder!("python-pages");
    fs::copy(firmware::dir().join("app-v1.elf"), folder.join("app.elf")).expect("the application");
    let at = TcpListener::bind("127.0.0.1:0").and_then(|free| free.local_addr()).expect("a port").to_string();
    let mut node = Command::new(node);
    node.args(["--node", "5", "--flash", "instant", "--stand-in", "--listen", &at, "--folder"]).arg(&*folder);
    let mut node = node.spawn().expect("the node starts");
    while TcpStream::connect(&at).is_err() {
        assert!(node.try_wait().expect("its state").is_none(), "the node has ended");
        std::thread::sleep(Duration::from_millis(50));
    }
    let run = |page: &str| {
        let page = fs::read_to_string(root().join(page)).expect("the page");
        let script =
            page.split("```python\n").find(|block| block.starts_with("import coflash\n")).expect("a script");
        let script = script.split("```").next().unwrap_or_default();
        let script = script.replace("socketcan:can0", &format!("socketcand://{at}/can0"));
        with_package().current_dir(&*folder).arg("-c").arg(script).output().expect("Python starts")
    };
    let outputs = ["coflash/python/README.md", "docs/coflash.md"].map(run);
    node.kill().and_then(|()| node.wait()).expect("it ends");
    for output in outputs {
        println!("{}", succeeded(&output));
    }
}

/// The script of a test bench: one line for each file, with the number of the error.
const SEALED: &str = "
import sys, coflash
bus, *files = sys.argv[1:]
for file in files:
    try:
        report = coflash.flash(bus, 1, file, verify=True)
        print(f'{report[\"size\"]} bytes, CRC {report[\"crc\"]:08X}')
    except coflash.DeviceError as error:
        print(f'{error.number:#010x}: {error.what}')
";

/// A sealed device accepts the valid file and refuses another one with its number in 1F57h.
#[test]
fn a_sealed_device_is_updated_from_python() {
    let bench = sealed_board::board().switched_on();
    let mut endpoint = Endpoint::new(bench);
    let image = firmware::raw(firmware::APP_V1);
    let genuine = sealed_board::sealer(sealed_board::COUNTER).seal(&image, &sealed_board::release()).unwrap();
    let mut flipped = genuine.clone();
    // In the image, whose hash the signature covers.
    flipped[50] ^= 1;
    let folder = kit::folder!("python-sealed");
    let mut python = with_package();
    python.args(["-c", SEALED]).arg(endpoint.url());
    // A bad signature makes the device wait, so it comes last.
    for (name, bytes) in [("genuine.cbs", &genuine), ("flipped.cbs", &flipped)] {
        python.arg(folder.write(name, bytes));
    }
    let said = text(&endpoint.run(&mut python));
    let lines: Vec<&str> = said.lines().collect();
    let [taken, refused] = lines.as_slice() else { panic!("{said}") };
    assert!(refused.starts_with("0x6000018a: ") && refused.contains("signature"), "{said}");
    let crc = kit::crc::crc32(&image);
    assert_eq!(*taken, format!("{} bytes, CRC {crc:08X}", image.len()));
    endpoint.bench.session().command(1, ProgramControl::Start).unwrap();
    // It remembers a bad signature for 32 s, and does not leave before (docs/security.md).
    endpoint.bench.await_boot_up(33_000);
    assert_eq!(endpoint.bench.session().read_text(Address::new(0x100A, 0)).unwrap(), "1.0.0");
    endpoint.bench.assert_nothing_unmodelled();
}
