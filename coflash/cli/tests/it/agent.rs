//! `coflash agent`, as people run it.

use kit::folder::Folder;
use kit::hawkbit::{Action, File, Server};

use crate::tool::{command, folder, run, Done};

/// The controller-ID of the device.
const ID: &str = "door";

/// The variables for proxies. Nobody listens there: whoever asks a proxy of the environment reaches
/// no server.
const PROXIES: [&str; 3] = ["http_proxy", "https_proxy", "ALL_PROXY"];

/// The command, as people run it.
fn call(folder: &Folder, arguments: &[&str]) -> Done {
    let proxies = PROXIES.map(|name| (name, "http://127.0.0.1:9/"));
    run(command().args(arguments).current_dir(folder).env("TOKEN_OF_THE_DOOR", "t-door").envs(proxies))
}

#[test]
fn the_command_tells_what_it_does_and_keeps_the_token_to_itself() {
    let (server, folder) = (Server::start(&[ID]), folder("command"));
    let door = "[[device]]\ncontroller-id = 'door'\nnode = 5\ntoken-env = 'TOKEN_OF_THE_DOOR'\n";
    std::fs::write(folder.join("agent.toml"), door).unwrap();
    // A file that is right and no program: the device is not needed.
    server.assign(ID, Action::new(3, &File::new("readme.txt", b"this is no firmware")));
    server.state().targets.get_mut(ID).unwrap().wants_attributes = false;
    let common = ["agent", "--once", "--bus", "socketcand://127.0.0.1:1/can0", "--hawkbit", &server.url];
    let log = ["--log-file", "log.txt", "--json-events"];
    let done = call(&folder, &[&common[..], &log].concat());
    done.fails(8, &[]);
    let Done { out, err, .. } = done;
    let lines: Vec<serde_json::Value> =
        out.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|_| panic!("{line}"))).collect();
    assert!(lines.iter().any(|line| line["event"] == "failed" && line["controller"] == ID), "{out}");
    assert_eq!(lines.last().unwrap()["failed"], 1, "{out}");
    assert_eq!(server.action(ID).result.as_deref(), Some("failure"));
    let log = std::fs::read_to_string(folder.join("log.txt")).unwrap();
    assert!(log.contains("readme.txt"), "{log}");
    assert!(![&out, &err, &log].iter().any(|text| text.contains("t-door")), "{out}{err}{log}");
    // Nothing to do is a success; a server that is not there is none.
    call(&folder, &common).says(&["0 updated, 0 failed, 0 not served"]);

    let wrong = |arguments: &[&str], words: &str| {
        let Done { exit, out, err, .. } = call(&folder, &[&["agent", "--once"], arguments].concat());
        assert!(exit != 0 && err.contains(words), "{arguments:?}: {out}{err}");
    };
    let bus = ["--bus", "socketcan:can0"];
    wrong(&["--devices", "none.toml"], "none.toml");
    wrong(&bus, "--hawkbit URL");
    wrong(&["--hawkbit", &server.url], "it has no bus");
    wrong(&[&bus[..], &["--hawkbit", "http://hawkbit.example.com"]].concat(), "plain text");
    wrong(&[&bus[..], &["--hawkbit", &server.url, "--trace", "x.log"]].concat(), "--trace");

    // The proxy of its own file: it hears of the server alone, and a server on this computer needs
    // none.
    let proxy = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let text = format!("proxy = 'http://{}'\nplain-http = true\n{door}", proxy.local_addr().unwrap());
    std::fs::write(folder.join("agent.toml"), text).unwrap();
    call(&folder, &common).says(&["0 updated, 0 failed, 0 not served"]);
    let asked = std::thread::spawn(move || {
        let mut line = String::new();
        let mut reader = std::io::BufReader::new(proxy.accept().unwrap().0);
        std::io::BufRead::read_line(&mut reader, &mut line).map(|_| line).unwrap()
    });
    wrong(&[&bus[..], &["--hawkbit", "http://hawkbit.invalid"]].concat(), "");
    assert_eq!(asked.join().unwrap(), "CONNECT hawkbit.invalid:80 HTTP/1.1\r\n");
    let text = format!("proxy = 'http://me:PLANTED@127.0.0.1:9'\n{door}");
    std::fs::write(folder.join("agent.toml"), text).unwrap();
    wrong(&[&bus[..], &["--hawkbit", &server.url]].concat(), "proxy: ");
}
