//! Installation of the hub as a service: the script installs and removes all files, and each unit is as restricted as
//! its settings promise.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::testkit::{TestEnv, output, skip};

/// Maximum exposure of a unit, in tenths of the level that `systemd-analyze security` reports (0.0 to 10.0).
const MAX_EXPOSURE: u32 = 15;

fn dist() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("hub/dist")
}

/// Returns all files below `directory`, with paths relative to it.
fn files(directory: &Path) -> Vec<String> {
    let mut all = Vec::new();
    let mut open = vec![directory.to_owned()];
    while let Some(next) = open.pop() {
        for entry in fs::read_dir(&next).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                open.push(path);
            } else {
                let path = path.strip_prefix(directory).expect("the path is below the directory");
                all.push(path.display().to_string());
            }
        }
    }
    all.sort();
    all
}

fn install(destination: &Path, words: &[&str]) -> (Option<i32>, String) {
    let output = output(Command::new(dist().join("install.sh")).args(words).env("DESTDIR", destination));
    let output = output.unwrap_or_else(|error| panic!("install.sh: {error}"));
    let text = [output.stdout, output.stderr].concat();
    (output.status.code(), String::from_utf8_lossy(&text).into_owned())
}

#[test]
fn install_script_removes_every_file_it_installs() {
    let env = TestEnv::new();
    let destination = env.path("machine");
    let program = env.path_argument("a program");
    std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_scanhub"), &program).expect("a name with a blank");
    let (code, text) = install(&destination, &["--program"]);
    assert!(code == Some(2) && text.contains("--program needs a file"), "{text}");
    for _ in 0..2 {
        let (code, text) = install(&destination, &["--program", &program]);
        assert_eq!(code, Some(0), "{text}");
    }
    let installed = files(&destination);
    for file in
        ["usr/local/bin/scanhub", "etc/systemd/system/scanhub.service", "etc/udev/rules.d/60-scanhub.rules"]
    {
        assert!(installed.iter().any(|path| path == file), "{file} is missing: {installed:?}");
    }
    let unit =
        fs::read_to_string(destination.join("etc/systemd/system/scanhub.service")).expect("the file exists");
    assert!(unit.contains("ExecStart=/usr/local/bin/scanhub run\n"));
    let (code, text) = install(&destination, &["--remove"]);
    assert_eq!((code, files(&destination)), (Some(0), Vec::new()), "{text}");
    let (code, text) = install(&destination, &["--program", "/no/such/program"]);
    assert!(code == Some(1) && text.contains("cargo build --release"), "{text}");
    let (code, text) = install(&destination, &["--prefix"]);
    assert!(code == Some(2) && text.contains("--program FILE, --remove"), "{text}");
}

#[test]
fn unit_allows_adapters_plugged_in_after_the_start() {
    let unit = fs::read_to_string(dist().join("scanhub.service")).expect("the file exists");
    let has_line = |line: &str| unit.lines().any(|it| it == line);
    // If no driver has registered a device group when the unit starts, systemd ignores the line for this group
    // (systemd.resource-control(5)).
    for (group, driver) in [("ttyUSB", "usbserial"), ("ttyACM", "cdc_acm")] {
        assert!(has_line(&format!("DeviceAllow=char-{group} rw")), "{group}");
        for key in ["Wants=", "After="] {
            let mut named = unit.lines().filter_map(|line| line.strip_prefix(key));
            let loads = format!("modprobe@{driver}.service");
            assert!(named.any(|units| units.split(' ').any(|it| it == loads)), "{key}{loads}");
        }
    }
}

/// Hub and gateway run as the same user, and only this user can read the state that they save.
#[test]
fn units_share_one_private_state_directory() {
    for unit in ["scanhub.service", "scanhub-gateway.service"] {
        let text = fs::read_to_string(dist().join(unit)).expect("the file exists");
        for expected in ["User=scanhub", "StateDirectory=scanhub", "StateDirectoryMode=0700", "UMask=0077"] {
            assert!(text.lines().any(|line| line == expected), "{unit}: {expected}");
        }
    }
}

#[test]
fn systemd_units_have_low_exposure() {
    for unit in ["scanhub.service", "scanhub-gateway.service"] {
        let path = dist().join(unit);
        let analyze = |words: &[&str]| output(Command::new("systemd-analyze").args(words).arg(&path));
        let limit = format!("--threshold={MAX_EXPOSURE}");
        let Ok(output) = analyze(&["security", "--offline=true", "--no-pager", &limit]) else {
            skip("systemd-analyze", "it is not installed");
            return;
        };
        let text = String::from_utf8_lossy(&output.stdout);
        if !text.contains("exposure level") {
            skip("systemd-analyze", "this version cannot check files");
            return;
        }
        assert!(output.status.success(), "{unit} exceeds the maximum exposure:\n{text}");
        // Ignore messages about programs that are not installed on this machine, because they are not faults of the
        // unit.
        let output = analyze(&["verify"]).unwrap_or_else(|error| panic!("{error}"));
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        let faults: Vec<_> = errors.lines().filter(|line| line.contains(unit)).collect();
        let is_fault = |line: &&&str| !line.contains("not executable") && !line.contains("man scanhub(1)");
        let faults: Vec<_> = faults.iter().filter(is_fault).collect();
        assert!(faults.is_empty(), "{faults:?}");
    }
}
