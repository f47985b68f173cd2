//! A foreign master updates a node of `coboot-node --run`, and the downloaded program really runs: a
//! Python program, in a ZIP file after the vector table (`docs/node.md`).

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::Duration;

use coboot_tests::tools::{coflash, given, python, script, succeeded};
use kit::folder::Folder;

/// The head of a program as the page makes it: an initial stack pointer in RAM, a reset vector inside
/// the program with the Thumb bit, and the rest of 512 bytes.
const VECTORS: [u8; 8] = [0x00, 0x00, 0x01, 0x20, 0x01, 0x02, 0x02, 0x08];

/// The block file of a Python program.
fn blocks(folder: &Folder, version: u8) -> String {
    let name = format!("version{version}");
    let app = folder.join(&name);
    fs::create_dir(&app).unwrap();
    let main = format!(
        "import os, signal, sys\n\
         def say(text):\n    print(text, file=open('ran', 'a'))\n\
         def end(*_):\n    say('version {version} was ended')\n    sys.exit()\n\
         signal.signal(signal.SIGTERM, end)\n\
         say('version {version} runs in node ' + os.environ['COBOOT_NODE_ID'])\n\
         sys.stdin.read()\n"
    );
    fs::write(app.join("__main__.py"), main).unwrap();
    let pyz = folder.join(format!("{name}.pyz"));
    println!(
        "{}",
        succeeded(&python().args(["-m", "zipapp"]).arg(&app).arg("-o").arg(&pyz).output().unwrap())
    );
    let mut program = [0; 512].to_vec();
    program[..8].copy_from_slice(&VECTORS);
    program.extend(fs::read(&pyz).unwrap());
    let bin = folder.write(format!("{name}.bin"), &program);
    let blocks = folder.join(format!("{name}.blk"));
    let mut convert = coflash();
    convert.args(["convert", "-I", "binary", "--board", "stm32f407g-disc1"]).arg(bin).arg(&blocks);
    println!("{}", succeeded(&convert.output().unwrap()));
    blocks.to_str().unwrap().to_owned()
}

/// The node, which ends with the test.
struct Node(Child);

impl Drop for Node {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn python_canopen_updates_a_node_whose_programs_run() {
    let folder = kit::folder!("hosted");
    let mut node = Command::new(given("COBOOT_NODE"));
    node.args(["--listen", "127.0.0.1:0", "--node", "9", "--flash", "instant", "--run"])
        .arg(python().get_program())
        .current_dir(&*folder)
        .stdout(Stdio::piped());
    let mut node = Node(node.spawn().unwrap());
    let mut out = BufReader::new(node.0.stdout.take().unwrap());
    let mut line = String::new();
    out.read_line(&mut line).unwrap();
    let address = line.trim().trim_start_matches("bus: socketcand://").trim_end_matches("/can0").to_owned();
    // Nothing reads the rest, and a full pipe would stop the node.
    thread::spawn(move || out.read_to_end(&mut Vec::new()));
    let ran = || fs::read_to_string(folder.join("ran")).unwrap_or_default();
    let mut expected = String::new();
    for version in [1, 2] {
        let blocks = blocks(&folder, version);
        let mut master = script("canopen_client.py");
        let said = succeeded(&master.args([&address, &blocks, "--node", "9"]).output().unwrap());
        assert_eq!(said.contains("called back into the bootloader"), version == 2, "{said}");
        assert!(said.contains("the application reports 1F51h = 01h and the same 1F56h"), "{said}");
        if version == 2 {
            expected += "version 1 was ended\n";
        }
        expected += &format!("version {version} runs in node 9\n");
        for _ in 0..24_000 {
            if ran() == expected {
                break;
            }
            thread::sleep(Duration::from_millis(5));
        }
        assert_eq!(ran(), expected);
    }
}
