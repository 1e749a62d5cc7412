//! Tests of the rules between crates: which crates and modules each crate may use, and how many dependencies it may
//! have.

use super::{assert_rule, crates};

#[test]
fn schema_depends_on_no_other_crate() {
    assert_rule(crates::schema_depends_on_no_other_crate, |tree| {
        vec![
            tree.with_line("schema/Cargo.toml", "[dependencies]", "scanhub-drivers.workspace = true"),
            tree.with_line("schema/Cargo.toml", "[dev-dependencies]", "scanhub-drivers.workspace = true"),
        ]
    });
}

#[test]
fn schema_uses_no_operating_system() {
    assert_rule(crates::schema_uses_no_operating_system, |tree| {
        let (manifest, lib) = ("schema/Cargo.toml", "schema/src/lib.rs");
        let planted = |code: &str| tree.with("schema/src/planted.rs", &format!("//! So.\n{code}\n"));
        vec![
            tree.with_line(manifest, "[dependencies]", "rustix.workspace = true"),
            tree.with(lib, &tree.text(lib).replace("#![forbid(unsafe_code)]", "")),
            planted("use std::thread;"),
            planted("use std::{\n    fmt,\n    fs::File,\n};"),
            planted("let address: std::net::IpAddr;"),
            planted("let now = std::time::Instant::now();"),
            planted("let id = std::process::id();"),
            planted("let page = memmap2::MmapRaw::map_raw(&file);"),
            planted("use nix::unistd::User;"),
        ]
    });
}

#[test]
fn shm_and_files_depend_only_on_schema() {
    assert_rule(crates::shm_and_files_depend_only_on_schema, |tree| {
        let (files, shm) = ("schema/files/Cargo.toml", "schema/shm/Cargo.toml");
        vec![
            tree.with_line(files, "[dependencies]", "scanhub-shm.workspace = true"),
            tree.with_line(shm, "[dependencies]", "scanhub-drivers.workspace = true"),
            tree.with_line(shm, "[dev-dependencies]", "scanhub-client.workspace = true"),
        ]
    });
    let crates = crates::dependency_tree("scanhub-files", &["--all-features"]);
    assert!(!crates.iter().any(|name| name.starts_with("iceoryx2")), "{crates:?}");
}

#[test]
fn modules_of_shm_form_layers() {
    assert_rule(crates::modules_of_shm_form_layers, |tree| {
        let planted = |module: &str, code: &str| {
            tree.with(&format!("schema/shm/src/{module}.rs"), &format!("//! So.\n{code}\n"))
        };
        vec![
            planted("directory", "use crate::segments::prefix_of;"),
            planted("segments", "crate::processes::holder(root)?;"),
            planted("shortage", "use crate::Domain;"),
            planted("shortage", "use crate::{domain::Domain, segments};"),
            planted("segments", "use super::processes::Node;"),
            planted("planted", "use crate::domain::Domain;"),
        ]
    });
}

#[test]
fn schema_without_ipc_needs_no_shared_memory() {
    let lan = crates::dependency_tree("scanhub-schema", &["--no-default-features"]);
    assert!(!lan.iter().any(|name| name.starts_with("iceoryx2")), "{lan:?}");
    let ipc = crates::dependency_tree("scanhub-schema", &["--no-default-features", "--features", "ipc"]);
    assert!(ipc.iter().any(|name| name.starts_with("iceoryx2")), "{ipc:?}");
}

#[test]
fn drivers_only_compute() {
    assert_rule(crates::drivers_only_compute, |tree| {
        let (manifest, lib) = ("hub/drivers/Cargo.toml", "hub/drivers/src/lib.rs");
        let planted =
            |code: &str| tree.with("hub/drivers/src/lms/planted.rs", &format!("//! A driver.\n{code}\n"));
        vec![
            tree.with_line(manifest, "[dependencies]", "serialport.workspace = true"),
            tree.with_line(manifest, "[dependencies]", "scanhub-port.workspace = true"),
            tree.with(lib, &tree.text(lib).replace("#![forbid(unsafe_code)]", "")),
            planted("use std::thread;"),
            planted("use std::{fmt, net};"),
            planted("let text = std::fs::read_to_string(path);"),
            planted("let now = std::time::Instant::now();"),
            planted("println!(\"a line\");"),
        ]
    });
}

#[test]
fn no_family_module_uses_another_family() {
    assert_rule(crates::no_family_module_uses_another_family, |tree| {
        let planted = |path: &str, code: &str| tree.with(path, &format!("//! A driver.\n{code}\n"));
        vec![
            planted("hub/drivers/src/ld/planted.rs", "use crate::lms::telegram::Telegram;"),
            planted("hub/drivers/src/rplidar.rs", "let session: ld::Session;"),
            planted("hub/drivers/src/lms/session.rs", "use crate::{line, rplidar};"),
            planted("hub/drivers/src/line/session.rs", "use crate::lms::SILENCE;"),
            planted("hub/drivers/src/ld/planted.rs", "use crate::Session;"),
        ]
    });
}

#[test]
fn rplidar_simulator_is_independent() {
    assert_rule(crates::rplidar_simulator_is_independent, |tree| {
        let planted =
            |code: &str| tree.with("hub/sim/src/rplidar/planted.rs", &format!("//! A unit.\n{code}\n"));
        vec![
            planted("use scanhub_drivers::rplidar::packet::Kind;"),
            planted("use scanhub_drivers::{\n    line, rplidar,\n};"),
            planted("let kind = scanhub_drivers::rplidar::packet::Kind::Dense;"),
            planted("use scanhub_drivers as drivers;"),
            planted("use scanhub_drivers::{self as drivers};"),
            planted("use scanhub_drivers::scanner::Session;"),
        ]
    });
}

#[test]
fn preprocess_only_computes() {
    assert_rule(crates::preprocess_only_computes, |tree| {
        let planted = |code: &str| tree.with("hub/preprocess/src/planted.rs", &format!("//! So.\n{code}\n"));
        let lib = tree.text("hub/preprocess/src/lib.rs");
        vec![
            tree.with_line("hub/preprocess/Cargo.toml", "[dependencies]", "scanhub-drivers.workspace = true"),
            tree.with_line("hub/preprocess/Cargo.toml", "[dependencies]", "iceoryx2.workspace = true"),
            tree.with("hub/preprocess/src/lib.rs", &lib.replace("#![forbid(unsafe_code)]", "")),
            planted("use std::time::Instant;"),
            planted("use std::{array, thread};"),
            planted("let ends = ranges.iter().collect::<Vec<_>>();"),
            planted("let ranges = vec![0; 401];"),
            planted("fn boxed(scan: &Scan) -> Box<Scan> {"),
            planted("let ranges: Vec<u16> = vec![0; beams];"),
            tree.with("hub/preprocess/src/marks/tests.rs", "//! So.\nlet ranges = Vec::new();\n"),
            planted("let name = format!(\"{i}\");"),
        ]
    });
}

#[test]
fn no_processor_uses_another() {
    assert_rule(crates::no_processor_uses_another, |tree| {
        let planted = |path: &str, code: &str| tree.with(path, &format!("//! So.\n{code}\n"));
        vec![
            planted("hub/preprocess/src/zones.rs", "use crate::marks::MarkDetector;"),
            planted("hub/preprocess/src/background/fixed.rs", "use crate::{zones, Reading};"),
            planted("hub/preprocess/src/segments.rs", "let class = super::background::Class::Unknown;"),
        ]
    });
}

#[test]
fn clients_depend_only_on_schema() {
    assert_rule(crates::clients_depend_only_on_schema, |tree| {
        let (client, verbs) = ("clients/client/Cargo.toml", "clients/verbs/Cargo.toml");
        vec![
            tree.with_line(client, "[dependencies]", "scanhub-drivers.workspace = true"),
            tree.with_line(client, "[dependencies]", "scanhub-verbs.workspace = true"),
            tree.with_line(client, "[dev-dependencies]", "scanhub-ros.workspace = true"),
            tree.with_line(verbs, "[dependencies]", "scanhub-drivers.workspace = true"),
        ]
    });
}

#[test]
fn ros_depends_only_on_schema() {
    assert_rule(crates::ros_depends_only_on_schema, |tree| {
        let (manifest, lib) = ("schema/ros/Cargo.toml", "schema/ros/src/lib.rs");
        vec![
            tree.with_line(manifest, "[dependencies]", "scanhub-client.workspace = true"),
            tree.with_line(manifest, "[dependencies]", "mcap.workspace = true"),
            tree.with(lib, &tree.text(lib).replace("#![forbid(unsafe_code)]", "")),
            tree.with("schema/ros/src/planted.rs", "//! A clock.\nuse std::time::SystemTime;\n"),
        ]
    });
}

#[test]
fn scene_only_computes() {
    assert_rule(crates::scene_only_computes, |tree| {
        let planted =
            |code: &str| tree.with("clients/viewer/src/scene/planted.rs", &format!("//! So.\n{code}\n"));
        vec![
            planted("use std::time::Instant;"),
            planted("use std::time::{Duration, SystemTime};"),
            planted("let text = std::fs::read_to_string(path)?;"),
            planted("let text = std::mem::take(&mut std::fs::read_to_string(path)?);"),
            planted("std::thread::spawn(run);"),
            planted("let now_ns = scanhub_client::clock::now_ns();"),
            planted("use crate::web::{WebOptions, web};"),
            tree.with("clients/viewer/src/scene.rs", "//! So.\nuse super::work::Work;\n"),
        ]
    });
}

#[test]
fn perception_only_computes() {
    assert_rule(crates::perception_only_computes, |tree| {
        let lib = "clients/perception/src/lib.rs";
        let planted = |path: &str, code: &str| {
            tree.with(&format!("clients/perception/src/{path}"), &format!("//! So.\n{code}\n"))
        };
        vec![
            tree.with_line(
                "clients/perception/Cargo.toml",
                "[dependencies]",
                "scanhub-drivers.workspace = true",
            ),
            tree.with(lib, &tree.text(lib).replace("#![forbid(unsafe_code)]", "")),
            planted("tilt/planted.rs", "use std::time::Instant;"),
            planted("tilt.rs", "let now = scanhub_client::clock::now_ns();"),
            planted("tilt/planted.rs", "use std::net::UdpSocket;"),
            planted("track/planted.rs", "let text = std::fs::read_to_string(path);"),
            planted("track/planted.rs", "use std::{fmt, fs};"),
            planted("track/planted.rs", "use scanhub_files::regular;"),
            planted("track.rs", "let worker = std::thread::spawn(work);"),
            planted("track/planted.rs", "use crate::verbs::Track;"),
        ]
    });
}

#[test]
fn viewer_server_depends_on_no_hub() {
    assert_rule(crates::viewer_server_depends_on_no_hub, |tree| {
        let lib = "clients/viewer/src/lib.rs";
        let planted =
            |code: &str| tree.with("clients/viewer/src/server/planted.rs", &format!("//! So.\n{code}\n"));
        vec![
            planted("use scanhub_client::subscribe;"),
            planted("use scanhub_verbs as verbs;"),
            planted("use scanhub_shm::Domain;"),
            planted("use std::fs::File;"),
            planted("use std::{fs, io};"),
            planted("std::process::Command::new(\"sh\");"),
            planted("use std as system;"),
            planted("use rustix::fs::open;"),
            planted("use rustix::{event, fs};"),
            planted("use crate::web::web;"),
            planted("use crate::{picture, scene};"),
            planted("use crate as viewer;"),
            planted("use super::super::picture::followed;"),
            tree.with("clients/viewer/src/server.rs", "//! So.\nuse super::picture::followed;\n"),
            tree.with(lib, &tree.text(lib).replace("#![forbid(unsafe_code)]", "")),
        ]
    });
}

#[test]
fn network_protocol_modules_only_compute() {
    assert_rule(crates::network_protocol_modules_only_compute, |tree| {
        let lib = "clients/network/src/lib.rs";
        let planted =
            |code: &str| tree.with("clients/network/src/lan/planted.rs", &format!("//! So.\n{code}\n"));
        vec![
            tree.with(lib, &tree.text(lib).replace("#![forbid(unsafe_code)]", "")),
            planted("use std::time::Instant;"),
            planted("use std::{fmt, net};"),
            planted("use std::net::UdpSocket;"),
            planted("let pid = std::process::id();"),
            planted("let text = std::fs::read_to_string(path);"),
            planted("std::thread::spawn(work);"),
            planted("use scanhub_client::clock;"),
            planted("let now = scanhub_client::clock::now_ns();"),
            planted("use socket2::Socket;"),
            planted("let now = crate::now();"),
            planted("use crate::interface::interfaces;"),
        ]
    });
}

#[test]
fn c_and_python_libraries_depend_only_on_clients() {
    assert_rule(crates::c_and_python_libraries_depend_only_on_clients, |tree| {
        let python = "clients/python/Cargo.toml";
        vec![
            tree.with_line(python, "[dependencies]", "scanhub-drivers.workspace = true"),
            tree.with_line(python, "[dependencies]", "iceoryx2.workspace = true"),
            tree.with_line(python, "[features]", "default = [\"read\"]"),
            tree.with_line("clients/verbs/Cargo.toml", "[dependencies]", "scanhub-python.workspace = true"),
            tree.with_line("clients/c/Cargo.toml", "[dependencies]", "scanhub-drivers.workspace = true"),
            tree.with_line("clients/c/Cargo.toml", "[dependencies]", "iceoryx2.workspace = true"),
            tree.with_line("clients/c/Cargo.toml", "[dependencies]", "scanhub-verbs.workspace = true"),
            tree.with_line("clients/verbs/Cargo.toml", "[dependencies]", "scanhub-c.workspace = true"),
            tree.with_line("Cargo.toml", "[dependencies]", "scanhub-c.workspace = true"),
        ]
    });
}

#[test]
fn daemon_depends_on_neither_clients_nor_sim() {
    assert_rule(crates::daemon_depends_on_neither_clients_nor_sim, |tree| {
        vec![
            tree.with_line("hub/daemon/Cargo.toml", "[dependencies]", "scanhub-client.workspace = true"),
            tree.with_line("hub/daemon/Cargo.toml", "[dependencies]", "scanhub-verbs.workspace = true"),
            tree.with_line("hub/port/Cargo.toml", "[dependencies]", "scanhub-network.workspace = true"),
            tree.with_line("hub/recording/Cargo.toml", "[dependencies]", "scanhub-sim.workspace = true"),
            tree.with_line("hub/port/Cargo.toml", "[dependencies]", "scanhub-lms-configure.workspace = true"),
            tree.with_line("hub/daemon/Cargo.toml", "[dependencies]", "scanhub-tools.workspace = true"),
        ]
    });
}

#[test]
fn only_the_program_depends_on_all_crates() {
    assert_rule(crates::only_the_program_depends_on_all_crates, |tree| {
        let python = "clients/python/Cargo.toml";
        vec![
            tree.with_line("hub/sim/Cargo.toml", "[dependencies]", "scanhub-daemon.workspace = true"),
            tree.with_line("hub/sim/Cargo.toml", "[dependencies]", "scanhub-client.workspace = true"),
            tree.with_line("hub/sim/Cargo.toml", "[dependencies]", "scanhub-network.workspace = true"),
            tree.with_line("Cargo.toml", "[dependencies]", "scanhub-world.workspace = true"),
            tree.with(python, &tree.text(python).replace(", optional = true", "")),
        ]
    });
}

#[test]
fn cargo_test_at_the_top_tests_every_crate() {
    assert_rule(crates::cargo_test_at_the_top_tests_every_crate, |tree| {
        let manifest = tree.text("Cargo.toml");
        vec![tree.with("Cargo.toml", &manifest.replacen("members = [", "members = [\"new\", ", 1))]
    });
}

#[test]
fn every_crate_uses_the_workspace_lints() {
    assert_rule(crates::every_crate_uses_the_workspace_lints, |tree| {
        let (top, sim) = (tree.text("Cargo.toml"), tree.text("hub/sim/Cargo.toml"));
        vec![
            tree.with("Cargo.toml", &top.replace("unsafe_code = \"deny\"", "unsafe_code = \"warn\"")),
            tree.with("hub/sim/Cargo.toml", &sim.replace("[lints]\nworkspace = true", "")),
        ]
    });
}

#[test]
fn shared_memory_library_version_is_pinned() {
    assert_rule(crates::shared_memory_library_version_is_pinned, |tree| {
        vec![tree.with("Cargo.toml", &tree.text("Cargo.toml").replace("version = \"=0.", "version = \"0."))]
    });
}

/// The hub has few dependencies: most of its crates come with shared memory, and serialport brings three.
#[test]
fn daemon_is_built_from_few_crates() {
    let mut crates = crates::dependency_tree("scanhub-daemon", &[]);
    crates.retain(|name| !name.starts_with("scanhub-"));
    eprintln!("daemon: {} crates of others", crates.len());
    assert!(crates.len() <= 82, "{} crates: {crates:#?}", crates.len());
}

/// In addition to the crates for shared memory, a client needs few crates. It needs neither the crate of the verbs nor
/// a crate that only verbs need.
#[test]
fn client_is_built_from_few_crates() {
    let mut crates = crates::dependency_tree("scanhub-client", &[]);
    // Compare with `scanhub-shm`, a crate of this workspace. Cargo lists the dependencies of a crate outside of the
    // workspace only if it has downloaded all crates, including those of the bridge.
    let shared_memory = crates::dependency_tree("scanhub-shm", &[]);
    crates.retain(|name| !shared_memory.contains(name));
    eprintln!("client: {} crates besides those of shared memory", crates.len());
    assert!(crates.len() <= 3, "{} crates: {crates:#?}", crates.len());
    const OF_VERBS: [&str; 8] = [
        "scanhub-verbs",
        "ratatui",
        "hdrhistogram",
        "serde_json",
        "mcap",
        "socket2",
        "strsim",
        "thread-priority",
    ];
    let of_verbs = |name: &&String| OF_VERBS.iter().any(|verb| name.split(' ').next() == Some(verb));
    assert_eq!(crates.iter().find(of_verbs), None);
    assert!(crates::dependency_tree("scanhub-verbs", &[]).iter().any(|name| of_verbs(&name)));
}

/// Only recordings need crates that are built with a C compiler.
#[test]
fn clients_that_do_not_record_need_no_c_compiler() {
    let in_c = |package: &str, features: &[&str]| {
        let crates = crates::dependency_tree(package, features);
        // `linux-raw-sys` ends with `-sys`, too, but it has no C code: it is the kernel's interface in Rust.
        let is_in_c = |name: &String| name.contains("-sys ") && !name.starts_with("linux-raw-sys");
        crates.into_iter().filter(is_in_c).collect::<Vec<_>>()
    };
    assert_eq!(in_c("scanhub-viewer", &[]), Vec::<String>::new());
    let recording = in_c("scanhub-verbs", &["--no-default-features", "--features", "record"]);
    assert!(recording.iter().any(|name| name.starts_with("zstd-sys")), "{recording:?}");
}
