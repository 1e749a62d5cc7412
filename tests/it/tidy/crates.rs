//! Rules for dependencies between crates. They are checked in the manifests, in the sources and in the output of `cargo
//! tree`.

use super::tree::{SourceTree, code, find};
use crate::testkit::output;
use std::collections::BTreeSet;
use std::process::Command;

/// Returns the crates of this project that a manifest lists in `sections`, such as `dependencies`.
fn own_dependencies(manifest: &toml::Table, sections: &[&str]) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for section in sections {
        let names =
            manifest.get(*section).and_then(toml::Value::as_table).into_iter().flat_map(toml::Table::keys);
        found.extend(names.filter(|name| name.starts_with("scanhub-")).cloned());
    }
    found
}

const ALL: [&str; 3] = ["dependencies", "dev-dependencies", "build-dependencies"];
const NORMAL: [&str; 1] = ["dependencies"];

pub(crate) fn schema_depends_on_no_other_crate(tree: &SourceTree) -> Vec<String> {
    own_dependencies(&tree.members()["scanhub-schema"], &ALL).into_iter().collect()
}

/// Finds uses of the operating system in the crate `schema`. Its payloads and names must be the same on every machine.
pub(crate) fn schema_uses_no_operating_system(tree: &SourceTree) -> Vec<String> {
    const OF_STD: [&str; 7] = ["env", "fs", "net", "os", "process", "thread", "time"];
    const CRATES: [&str; 4] = ["memmap2", "nix", "rustix", "tempfile"];
    let known = ["bytemuck", "crc", "iceoryx2", "mcap", "serde", "serde_json"];
    let mut breaches = dependencies_beyond(tree, "scanhub-schema", &known);
    breaches.extend(missing_attributes(tree, "schema/src/lib.rs", &["#![forbid(unsafe_code)]"]));
    for (path, text) in tree.sources().filter(|(path, _)| path.starts_with("schema/src/")) {
        // Join the lines, because a list of names in a `use` may have several lines.
        let text: String = code(text).map(|(_, line)| format!("{line} ")).collect();
        breaches.extend(
            text.split(';')
                .filter(|statement| {
                    let of_std = statement.split("std::").skip(1).any(|path| {
                        let list = path.strip_prefix('{').and_then(|list| list.split('}').next());
                        let names = list.unwrap_or_else(|| words(path).next().unwrap_or_default());
                        words(names).any(|name| OF_STD.contains(&name))
                    });
                    of_std || words(statement).any(|word| CRATES.contains(&word))
                })
                .map(|statement| format!("{path}: {}", statement.trim())),
        );
    }
    breaches
}

fn words(text: &str) -> impl Iterator<Item = &str> {
    text.split(|c: char| !c.is_alphanumeric() && c != '_')
}

/// Finds crates of this project that `shm` and `files` use but may not use.
pub(crate) fn shm_and_files_depend_only_on_schema(tree: &SourceTree) -> Vec<String> {
    let known: [(&str, &[&str]); 2] =
        [("scanhub-files", &["scanhub-schema"]), ("scanhub-shm", &["scanhub-files", "scanhub-schema"])];
    forbidden_dependencies(tree, &known)
}

/// Returns the names of all crates in the dependencies of a manifest, except those that only tests need.
fn built_dependencies(manifest: &toml::Table) -> impl Iterator<Item = &String> {
    let sections = ["dependencies", "build-dependencies"].into_iter();
    let tables = sections.filter_map(|section| manifest.get(section).and_then(toml::Value::as_table));
    tables.flat_map(toml::Table::keys)
}

/// Finds code in the drivers that does more than compute. Drivers get time and bytes as arguments, so that the same
/// code runs on a port, on a recording and in virtual time.
pub(crate) fn drivers_only_compute(tree: &SourceTree) -> Vec<String> {
    let mut breaches = dependencies_beyond(tree, "scanhub-drivers", &["scanhub-schema"]);
    breaches.extend(missing_attributes(tree, "hub/drivers/src/lib.rs", &["#![forbid(unsafe_code)]"]));
    breaches.extend(forbidden_paths(tree, "hub/drivers/src/"));
    breaches
}

/// Finds names of one scanner family in the code of another family, and names of families in the code that all families
/// share.
pub(crate) fn no_family_module_uses_another_family(tree: &SourceTree) -> Vec<String> {
    const FAMILIES: [&str; 3] = ["ld", "lms", "rplidar"];
    let mut breaches = Vec::new();
    for own in ["ld", "line", "lms", "rplidar"] {
        let (file, folder) = (format!("hub/drivers/src/{own}.rs"), format!("hub/drivers/src/{own}/"));
        let is_own = |path: &str| path == file || path.starts_with(&folder);
        for (path, text) in tree.sources().filter(|(path, _)| is_own(path)) {
            for (number, line) in code(text) {
                let mut words = line.split(|c: char| !c.is_alphanumeric() && c != '_');
                // A line that uses the list of the families is a violation, too, because the list gives access to every
                // family.
                let is_list = line.contains("families") || line.contains("crate::Session");
                if is_list || words.any(|word| word != own && FAMILIES.contains(&word)) {
                    breaches.push(format!("{path}:{number}: {}", line.trim()));
                }
            }
        }
    }
    breaches
}

/// Finds uses of the RPLIDAR's driver in the simulator. If driver and simulator used one description of the protocol,
/// tests would not find an error in this description.
pub(crate) fn rplidar_simulator_is_independent(tree: &SourceTree) -> Vec<String> {
    let mut breaches = Vec::new();
    for (path, text) in tree.sources().filter(|(path, _)| path.starts_with("hub/sim/src/")) {
        let text: String = code(text).map(|(_, line)| format!("{line} ")).collect();
        let statements = text.split(';').filter(|statement| statement.contains("scanhub_drivers"));
        let naming = statements.filter(|statement| {
            let (_, path) = statement.split_once("scanhub_drivers").unwrap_or_default();
            let mut words = path.split(|c: char| !c.is_alphanumeric() && c != '_');
            // An alias and the list of the families are violations, too, because through them code could use the driver
            // without its name.
            words.any(|word| ["rplidar", "scanner"].contains(&word))
                || path.trim_start().starts_with("as ")
                || path.starts_with("::{self")
        });
        breaches.extend(naming.map(|statement| format!("{path}: {}", statement.trim())));
    }
    breaches
}

/// Finds uses of the operating system in the code in `folder`: clocks, sockets, files, threads, processes and output.
fn forbidden_paths(tree: &SourceTree, folder: &str) -> Vec<String> {
    const HARMLESS: [&str; 4] = ["std::f32", "std::f64", "std::fmt", "std::ops"];
    let below = |path: &str| path.starts_with(folder);
    let mut breaches = find(tree, &["extern crate", "println!", "eprint"], below);
    let mut of_std = find(tree, &["std::"], below);
    of_std.retain(|place| {
        place.matches("std::").count() > HARMLESS.iter().map(|name| place.matches(name).count()).sum()
    });
    breaches.extend(of_std);
    breaches
}

/// Finds code that does more than compute in the crate that encodes EEPROM writes.
pub(crate) fn eeprom_writer_only_computes(tree: &SourceTree) -> Vec<String> {
    let mut breaches =
        dependencies_beyond(tree, "scanhub-lms-configure", &["scanhub-drivers", "scanhub-schema"]);
    breaches.extend(missing_attributes(tree, "hub/lms-configure/src/lib.rs", &["#![forbid(unsafe_code)]"]));
    breaches.extend(forbidden_paths(tree, "hub/lms-configure/src/"));
    breaches
}

/// Finds crates that are built with the requests that write the EEPROM, except the two that are allowed: the crate that
/// asks a person first, and the simulator. Dependencies of tests do not count.
pub(crate) fn few_crates_can_write_the_eeprom(tree: &SourceTree) -> Vec<String> {
    const ALLOWED_CRATES: [&str; 2] = ["scanhub-tools", "scanhub-sim"];
    let top = ("scanhub".to_owned(), tree.manifest("Cargo.toml"));
    let others =
        tree.members().into_iter().chain([top]).filter(|(name, _)| !ALLOWED_CRATES.contains(&name.as_str()));
    // The crate of the fuzzer is a test, so it is not checked.
    let built = others.filter(|(name, _)| name != "scanhub-fuzz");
    built
        .filter(|(_, manifest)| built_dependencies(manifest).any(|name| name == "scanhub-lms-configure"))
        .map(|(name, _)| format!("{name} is built with the EEPROM writer"))
        .collect()
}

fn missing_attributes(tree: &SourceTree, path: &str, attributes: &[&str]) -> Vec<String> {
    let has = |attribute: &str| tree.text(path).lines().any(|line| line == attribute);
    let missing = attributes.iter().filter(|attribute| !has(attribute));
    missing.map(|attribute| format!("{path} lacks {attribute}")).collect()
}

/// Finds code in `preprocess` that does more than compute, and allocations. The crate computes payloads from payloads.
/// It may not use telegrams, shared memory or the operating system. After a processor was created, it may not use the
/// heap.
pub(crate) fn preprocess_only_computes(tree: &SourceTree) -> Vec<String> {
    const HEAP: [&str; 12] = [
        "Vec<",
        "Vec::",
        "vec!",
        "Box<",
        "Box::",
        "String",
        "format!",
        "to_owned()",
        "to_string()",
        "to_vec()",
        "collect()",
        "collect::",
    ];
    // All other modules of `std` are forbidden, such as those of Rc, Arc, maps, clocks, threads and files.
    const HARMLESS: [&str; 7] =
        ["std::array", "std::error", "std::f32", "std::f64", "std::fmt", "std::mem", "std::ops"];
    let is_of_tests = |path: &str| {
        let parent = path.strip_suffix("/tests.rs").map(|module| tree.text(&format!("{module}.rs")));
        parent.is_some_and(|text| text.contains("\n#[cfg(test)]\nmod tests;"))
    };
    let ours = |path: &str| path.starts_with("hub/preprocess/src/") && !is_of_tests(path);
    let manifest = &tree.members()["scanhub-preprocess"];
    let mut breaches: Vec<String> =
        built_dependencies(manifest).filter(|name| *name != "scanhub-schema").cloned().collect();
    breaches.extend(missing_attributes(tree, "hub/preprocess/src/lib.rs", &["#![forbid(unsafe_code)]"]));
    let mut on_heap = find(tree, &HEAP, ours);
    // A processor allocates its memory once, for the number of its sensor's beams or for the cells of a map. The lists
    // in settings (radii and sectors) are allocated before that.
    on_heap.retain(|place| {
        let (file, line) = place.split_once(": ").unwrap_or_default();
        let is_setting = ["radii_mm: ", "body_mask: ", "pub radii_mm: ", "pub body_mask: "];
        if file.starts_with("hub/preprocess/src/zones.rs") && is_setting.iter().any(|it| line.starts_with(it))
        {
            return false;
        }
        let for_beams = place.matches("Box<[").count()
            + place.matches("; beams").count()
            + place.matches("; CELL_COUNT]").count();
        HEAP.iter().map(|word| place.matches(word).count()).sum::<usize>() > for_beams
    });
    breaches.extend(on_heap);
    breaches.extend(find(tree, &["extern crate"], ours));
    let mut of_std = find(tree, &["std::"], ours);
    of_std.retain(|place| {
        place.matches("std::").count() > HARMLESS.iter().map(|name| place.matches(name).count()).sum()
    });
    breaches.extend(of_std);
    breaches
}

/// Finds processors that use another processor. The result of a processor must not depend on which other processors
/// run. Motion may use its own instance of the line finder.
pub(crate) fn no_processor_uses_another(tree: &SourceTree) -> Vec<String> {
    const BELOW: &str = "hub/preprocess/src/";
    const PROCESSORS: [&str; 6] = ["zones", "marks", "lines", "motion", "background", "segments"];
    let mut breaches = Vec::new();
    for own in PROCESSORS {
        let is_own = |path: &str| {
            let below = path.strip_prefix(BELOW).and_then(|path| path.strip_prefix(own));
            below.is_some_and(|rest| rest.starts_with(['.', '/']))
        };
        breaches.extend(find(tree, &["crate::", "super::"], is_own).into_iter().filter(|place| {
            let (_, code) = place.split_once(": ").unwrap_or_default();
            let mut words = code.split(|c: char| !c.is_alphanumeric() && c != '_');
            words.any(|word| word != own && PROCESSORS.contains(&word) && (own, word) != ("motion", "lines"))
        }));
    }
    breaches
}

/// Finds crates of this project that the client library, or a crate that uses it, depends on but may not use. The
/// client library may use only `schema` and `shm`. The verbs may use the client library, as any client does, and `ros`
/// for recordings. The network and the viewer may use the verbs.
pub(crate) fn clients_depend_only_on_schema(tree: &SourceTree) -> Vec<String> {
    let known: [(&str, &[&str]); 4] = [
        // The client library lists itself as a dependency of its tests, to enable its features.
        ("scanhub-client", &["scanhub-client", "scanhub-schema", "scanhub-shm"]),
        (
            "scanhub-network",
            &["scanhub-client", "scanhub-files", "scanhub-schema", "scanhub-shm", "scanhub-verbs"],
        ),
        (
            "scanhub-verbs",
            &["scanhub-client", "scanhub-files", "scanhub-schema", "scanhub-shm", "scanhub-ros"],
        ),
        (
            "scanhub-viewer",
            &[
                "scanhub-client",
                "scanhub-files",
                "scanhub-ros",
                "scanhub-schema",
                "scanhub-shm",
                "scanhub-verbs",
            ],
        ),
    ];
    forbidden_dependencies(tree, &known)
}

/// Finds modules of `shm` that use a module below them in the list at the start of the crate. A module may use only
/// modules above it in this list.
pub(crate) fn modules_of_shm_form_layers(tree: &SourceTree) -> Vec<String> {
    const FOLDER: &str = "schema/shm/src/";
    let lib = tree.text("schema/shm/src/lib.rs");
    let list = lib.lines().filter_map(|line| line.strip_prefix("//! - "));
    let layers: Vec<&str> = list.flat_map(|line| line.split('`').skip(1).step_by(2)).collect();
    let mut breaches = Vec::new();
    for (path, text) in tree.sources() {
        let Some(file) = path.strip_prefix(FOLDER).filter(|file| *file != "lib.rs") else { continue };
        let module = words(file).next().unwrap_or_default();
        let Some(layer) = layers.iter().position(|layer| *layer == module) else {
            breaches.push(format!("{path} is not in the list of layers"));
            continue;
        };
        for (number, line) in code(text) {
            let mut used = line.split("crate::").skip(1).filter_map(|rest| words(rest).next());
            // A name directly below `crate::` may come from any module, so it is a violation.
            let is_below = |name: &str| name == module || layers[..layer].contains(&name);
            let is_above = !file.contains('/') && line.contains("super::");
            if is_above || used.any(|name| !is_below(name)) {
                breaches.push(format!("{path}:{number}: {}", line.trim()));
            }
        }
    }
    breaches
}

/// Returns the crates of this project that a crate in `known` depends on, but that its entry does not allow.
fn forbidden_dependencies(tree: &SourceTree, known: &[(&str, &[&str])]) -> Vec<String> {
    let members = tree.members();
    let others = known.iter().flat_map(|(name, known)| {
        let names = own_dependencies(&members[*name], &ALL)
            .into_iter()
            .filter(|other| !known.contains(&other.as_str()));
        names.map(move |other| format!("{name} knows {other}"))
    });
    others.collect()
}

/// Finds code in `ros` that does more than turn payloads into messages. The crate `ros` may use only `schema`, so that
/// any crate can use `ros`.
pub(crate) fn ros_depends_only_on_schema(tree: &SourceTree) -> Vec<String> {
    let mut breaches = dependencies_beyond(tree, "scanhub-ros", &["scanhub-schema", "sha2"]);
    breaches.extend(missing_attributes(tree, "schema/ros/src/lib.rs", &["#![forbid(unsafe_code)]"]));
    let ours = |path: &str| path.starts_with("schema/ros/src/");
    breaches.extend(find(tree, &["std::time", "std::net", "std::fs", "extern crate"], ours));
    breaches
}

/// Finds code in the network's `lan` module that does more than turn samples into datagrams and back. The module gets
/// bytes and time as arguments, so that the same code runs in a simulation and with sockets.
pub(crate) fn network_protocol_modules_only_compute(tree: &SourceTree) -> Vec<String> {
    const FOLDER: &str = "clients/network/src/lan";
    const OF_STD: [&str; 8] = ["array", "cmp", "collections", "fmt", "mem", "num", "ops", "time::Duration"];
    const CRATES: [&str; 3] = ["hmac", "scanhub-schema", "sha2"];
    let mut breaches = missing_attributes(tree, "clients/network/src/lib.rs", &["#![forbid(unsafe_code)]"]);
    let manifest = tree.manifest("clients/network/Cargo.toml");
    let others = built_dependencies(&manifest).filter(|name| !CRATES.contains(&name.as_str()));
    let others: Vec<_> = others.map(|name| name.replace('-', "_")).collect();
    for (path, text) in tree.sources().filter(|(path, _)| path.starts_with(FOLDER)) {
        // Leave out the unit tests at the end of a file, which may use more.
        let text = text.split("\n#[cfg(test)]\nmod tests {").next().unwrap_or_default();
        for (number, line) in code(text).filter(|_| !path.ends_with("/tests.rs")) {
            let mut of_std = line.split("std::").skip(1);
            let is_other_std = of_std.any(|rest| !OF_STD.iter().any(|known| rest.starts_with(known)));
            let is_other_crate = words(line).any(|word| others.iter().any(|other| other == word));
            // Other modules of this crate have clocks and sockets.
            let is_outside = line.split("crate::").skip(1).any(|rest| !rest.starts_with("lan"));
            let is_output = ["extern crate", "println!", "eprint"].iter().any(|word| line.contains(word));
            if is_other_std || is_other_crate || is_outside || is_output {
                breaches.push(format!("{path}:{number}: {}", line.trim()));
            }
        }
    }
    breaches
}

/// Finds code in the viewer's module `scene` that does more than compute. The module gets samples and times as
/// arguments, so that a terminal and a browser show the same picture.
pub(crate) fn scene_only_computes(tree: &SourceTree) -> Vec<String> {
    const HARMLESS: [&str; 5] =
        ["std::collections", "std::fmt", "std::iter", "std::mem", "std::time::Duration"];
    let is_harmless = |place: &String| {
        let harmless: usize = HARMLESS.iter().map(|name| place.matches(name).count()).sum();
        place.matches("std::").count() == harmless
    };
    let mut breaches = forbidden_names(tree, &VIEWER, "scene", &["scanhub-schema"], &[]);
    breaches.extend(
        forbidden_paths(tree, "clients/viewer/src/scene").into_iter().filter(|place| !is_harmless(place)),
    );
    breaches
}

/// Finds clocks, sockets, files and threads in the modules `track` and `tilt`, which compute people and points. They
/// get the time as an argument, so that a recording gives the same result as a live sensor.
pub(crate) fn perception_only_computes(tree: &SourceTree) -> Vec<String> {
    const OUTSIDE: [&str; 17] = [
        "Instant",
        "SystemTime",
        "std::env",
        "std::fs",
        "std::io",
        "std::net",
        "std::os",
        "std::path",
        "std::process",
        "std::sync",
        "std::thread",
        "std::{",
        "scanhub_client",
        "scanhub_files",
        "scanhub_shm",
        "scanhub_verbs",
        "crate::verbs",
    ];
    const KNOWN_CRATES: [&str; 11] = [
        "clap",
        "nalgebra",
        "pathfinding",
        "scanhub-client",
        "scanhub-files",
        "scanhub-schema",
        "scanhub-shm",
        "scanhub-verbs",
        "serde",
        "strsim",
        "toml",
    ];
    let mut breaches = dependencies_beyond(tree, "scanhub-perception", &KNOWN_CRATES);
    breaches.extend(missing_attributes(tree, "clients/perception/src/lib.rs", &["#![forbid(unsafe_code)]"]));
    for module in ["tilt", "track"] {
        let (file, folder) =
            (format!("clients/perception/src/{module}.rs"), format!("clients/perception/src/{module}/"));
        let is_own = |path: &str| path == file || path.starts_with(&folder);
        breaches.extend(find(tree, &OUTSIDE, is_own));
        breaches.extend(find(tree, &["extern crate", "println!", "eprint", "clap", "rustix"], is_own));
    }
    breaches
}

/// Finds code in the web server that could reach a hub, a file or a process. The server handles input of strangers, so
/// it must not be able to do this. The rule lists the crates and the modules of its own crate that the server may use,
/// so that it cannot subscribe through another module, either.
pub(crate) fn viewer_server_depends_on_no_hub(tree: &SourceTree) -> Vec<String> {
    const CRATES: [&str; 9] = [
        "data-encoding",
        "httparse",
        "rustix",
        "scanhub-ros",
        "scanhub-schema",
        "serde",
        "serde_json",
        "sha2",
        "tungstenite",
    ];
    const OUTSIDE: [&str; 10] = [
        "extern crate",
        "std as",
        "std::env",
        "std::fs",
        "std::process",
        "std::{",
        "rustix as",
        "rustix::fs",
        "rustix::process",
        "rustix::{",
    ];
    let mut breaches = forbidden_names(tree, &VIEWER, "server", &CRATES, &["scene"]);
    breaches.extend(missing_attributes(tree, "clients/viewer/src/lib.rs", &["#![forbid(unsafe_code)]"]));
    breaches.extend(find(tree, &OUTSIDE, |path| path.starts_with("clients/viewer/src/server")));
    breaches
}

/// Name of a crate, and folder of the crate's sources.
struct Sources {
    name: &'static str,
    folder: &'static str,
}

const VIEWER: Sources = Sources { name: "scanhub-viewer", folder: "clients/viewer/src" };

/// Finds forbidden names in `module` of the crate `of`. A module is a file with a folder of the same name. It may use
/// only `modules` of its crate, and only `crates` of the crate's dependencies.
fn forbidden_names(
    tree: &SourceTree,
    of: &Sources,
    module: &str,
    crates: &[&str],
    modules: &[&str],
) -> Vec<String> {
    let manifest = &tree.members()[of.name];
    let others: Vec<String> = built_dependencies(manifest)
        .filter(|name| !crates.contains(&name.as_str()))
        .map(|name| name.replace('-', "_"))
        .collect();
    let (file, folder) = (format!("{}/{module}.rs", of.folder), format!("{}/{module}/", of.folder));
    let mut breaches = Vec::new();
    for (path, text) in tree.sources().filter(|(path, _)| *path == file || path.starts_with(&folder)) {
        for (number, line) in code(text) {
            let line = line.replace("pub(crate)", "pub");
            // After each mention of the crate's name, a path to an allowed module must follow. An alias or a list is a
            // violation.
            let is_allowed = |rest: &str| {
                let next = rest.strip_prefix("::").and_then(|rest| words(rest).next()).unwrap_or_default();
                next == module || modules.contains(&next)
            };
            let leaves = words(&line).filter(|word| *word == "crate").count()
                != line.match_indices("crate::").filter(|(at, _)| is_allowed(&line[at + 5..])).count()
                || line.contains("super::super")
                || path == file && words(&line).any(|word| word == "super");
            if leaves || words(&line).any(|word| others.iter().any(|other| other == word)) {
                breaches.push(format!("{path}:{number}: {}", line.trim()));
            }
        }
    }
    breaches
}

/// Returns the crates in the dependencies of `package`, except those that only tests need and those in `known`.
fn dependencies_beyond(tree: &SourceTree, package: &str, known: &[&str]) -> Vec<String> {
    let members = tree.members();
    let others = built_dependencies(&members[package]).filter(|name| !known.contains(&name.as_str()));
    others.map(|name| format!("{package} is built with {name}")).collect()
}

/// Removes crates of the hub from the manifest of the Python package. The package needs them only for its feature
/// `read`, which computes the samples of a replay. A crate is not removed if it is not optional, or if another feature
/// names it.
fn remove_feature_read(manifest: &mut toml::Table) {
    const OF_READ: [&str; 3] = ["scanhub-config", "scanhub-daemon", "scanhub-recording"];
    let features = manifest.get("features").and_then(toml::Value::as_table).cloned().unwrap_or_default();
    let names = |feature: &toml::Value, name: &str| {
        feature.as_array().into_iter().flatten().any(|word| word.as_str() == Some(name))
    };
    let dependencies = manifest.get_mut("dependencies").and_then(toml::Value::as_table_mut);
    let dependencies = dependencies.expect("a crate has dependencies");
    for name in OF_READ {
        let is_optional = dependencies.get(name).and_then(|it| it.get("optional")) == Some(&true.into());
        let with = format!("dep:{name}");
        let of_read_alone = features.iter().all(|(feature, words)| match &feature[..] {
            "read" => names(words, &with),
            _ => !names(words, &with) && !names(words, "read"),
        });
        if is_optional && of_read_alone {
            dependencies.remove(name);
        }
    }
}

/// Finds dependencies that the libraries for C and Python have in addition to the client library. Also finds crates
/// that depend on these libraries.
pub(crate) fn c_and_python_libraries_depend_only_on_clients(tree: &SourceTree) -> Vec<String> {
    let mut members = tree.members();
    members.entry("scanhub-python".to_owned()).and_modify(remove_feature_read);
    let mut breaches = Vec::new();
    for (own, others) in [("scanhub-c", &[][..]), ("scanhub-python", &["bytemuck", "pyo3"])] {
        let known = [&["scanhub-client", "scanhub-schema"], others].concat();
        let is_known = |name: &&String| known.contains(&name.as_str());
        breaches.extend(built_dependencies(&members[own]).filter(|name| !is_known(name)).cloned());
        let top = ("scanhub".to_owned(), tree.manifest("Cargo.toml"));
        let all = members.clone().into_iter().chain([top]);
        breaches.extend(all.filter_map(|(name, manifest)| {
            built_dependencies(&manifest)
                .any(|known| known == own)
                .then(|| format!("{name} is built with {own}"))
        }));
    }
    breaches
}

/// Finds crates of clients, of the simulator and of the EEPROM writer among the direct and indirect dependencies of the
/// daemon.
pub(crate) fn daemon_depends_on_neither_clients_nor_sim(tree: &SourceTree) -> Vec<String> {
    let members = tree.members();
    let mut reached = BTreeSet::new();
    let mut open = vec!["scanhub-daemon".to_owned()];
    while let Some(name) = open.pop() {
        open.extend(
            own_dependencies(&members[&name], &NORMAL).into_iter().filter(|name| !reached.contains(name)),
        );
        reached.insert(name);
    }
    const NON_DEPENDENCIES: [&str; 8] = [
        "scanhub-client",
        "scanhub-network",
        "scanhub-perception",
        "scanhub-verbs",
        "scanhub-viewer",
        "scanhub-sim",
        "scanhub-tools",
        "scanhub-lms-configure",
    ];
    reached.into_iter().filter(|name| NON_DEPENDENCIES.contains(&name.as_str())).collect()
}

/// Finds crates that depend on more than one of daemon, clients, simulator and tools. Only the program may combine
/// them.
pub(crate) fn only_the_program_depends_on_all_crates(tree: &SourceTree) -> Vec<String> {
    let ends: [&[&str]; 4] = [
        &["scanhub-daemon"],
        &["scanhub-client", "scanhub-network", "scanhub-perception", "scanhub-verbs", "scanhub-viewer"],
        &["scanhub-sim"],
        &["scanhub-tools"],
    ];
    let mut breaches = Vec::new();
    for (name, mut manifest) in tree.members() {
        if name == WORLD {
            continue;
        }
        if name == "scanhub-python" {
            remove_feature_read(&mut manifest);
        }
        let mut known = own_dependencies(&manifest, &NORMAL);
        known.insert(name.clone());
        let met = ends.iter().filter(|end| end.iter().any(|name| known.contains(*name))).count();
        if met > 1 {
            known.retain(|known| ends.concat().contains(&known.as_str()));
            breaches.push(format!("{name} brings {known:?} together"));
        }
    }
    let all = tree.members().into_values().chain([tree.manifest("Cargo.toml")]);
    if all.into_iter().any(|manifest| own_dependencies(&manifest, &NORMAL).contains(WORLD)) {
        breaches.push(format!("{WORLD} is only for tests"));
    }
    breaches
}

/// Crate of tests that runs hub, clients and simulators in one thread. It may depend on all of them, because no program
/// contains it.
const WORLD: &str = "scanhub-world";

/// Finds crates that `cargo test` in the project's root would not test.
pub(crate) fn cargo_test_at_the_top_tests_every_crate(tree: &SourceTree) -> Vec<String> {
    let manifest = tree.manifest("Cargo.toml");
    let list = |key: &str| -> BTreeSet<String> {
        let list = manifest["workspace"].get(key).and_then(toml::Value::as_array).into_iter().flatten();
        list.filter_map(toml::Value::as_str).map(str::to_owned).collect()
    };
    let mut expected = list("members");
    expected.insert(".".to_owned());
    // The bridge needs Zenoh and the Python package needs Python, so neither is a default member of the workspace.
    let apart = ["clients/bridge", "clients/python"].map(|member| expected.take(member));
    let mut breaches: Vec<String> = expected
        .difference(&list("default-members"))
        .map(|member| format!("{member} is not a default member"))
        .collect();
    if apart.iter().all(Option::is_some) {
        breaches.extend(missing_attributes(tree, ".ci/run", &["step cargo test --package scanhub-bridge"]));
        // The tests of the Python package use the result of this script.
        if !tree.text(".ci/run").contains("step clients/python/build.sh") {
            breaches.push(".ci/run does not build clients/python".to_owned());
        }
    }
    breaches
}

/// Finds crates that do not inherit the workspace's lints, which deny unsafe code.
pub(crate) fn every_crate_uses_the_workspace_lints(tree: &SourceTree) -> Vec<String> {
    let top = tree.manifest("Cargo.toml");
    let mut breaches = Vec::new();
    if top["workspace"]["lints"]["rust"]["unsafe_code"].as_str() != Some("deny") {
        breaches.push("the workspace does not deny unsafe code".to_owned());
    }
    let manifests = tree.members().into_iter().chain([("scanhub".to_owned(), top)]);
    breaches.extend(manifests.filter_map(|(name, manifest)| {
        let obeys =
            manifest.get("lints").and_then(|lints| lints.get("workspace")).and_then(toml::Value::as_bool);
        (obeys != Some(true)).then(|| format!("{name} has lints of its own"))
    }));
    breaches
}

/// Checks that the manifest pins the exact version of `iceoryx2`, because a hub and clients with different versions
/// cannot share memory.
pub(crate) fn shared_memory_library_version_is_pinned(tree: &SourceTree) -> Vec<String> {
    let manifest = tree.manifest("Cargo.toml");
    let version = manifest["workspace"]["dependencies"]["iceoryx2"]["version"].as_str().unwrap_or_default();
    if version.starts_with('=') { Vec::new() } else { vec![format!("iceoryx2 {version:?}")] }
}

/// Returns the names and versions of the crates that `package` is built from, including itself, as Cargo resolves them
/// on this machine.
pub(crate) fn dependency_tree(package: &str, features: &[&str]) -> BTreeSet<String> {
    let mut cargo = Command::new(env!("CARGO"));
    cargo.current_dir(env!("CARGO_MANIFEST_DIR")).args(["tree", "--offline", "--edges", "normal"]);
    cargo.args(["--prefix", "none", "--format", "{p}", "--package", package]).args(features);
    let output = output(cargo).expect("cargo can be called");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let listing = String::from_utf8(output.stdout).expect("names are text");
    // A line has the form "name v1.2.3 (path or *)". Two versions of a crate count as two crates.
    let names: BTreeSet<String> =
        listing.lines().map(|line| line.split(' ').take(2).collect::<Vec<_>>().join(" ")).collect();
    assert!(names.iter().any(|name| name.starts_with(package)), "{package} is built from {names:?}");
    names
}
