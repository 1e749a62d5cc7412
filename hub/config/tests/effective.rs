//! Tests of the values in effect. Each value of each link has a position in its source. The reported values are the
//! values that the hub uses.

use std::fs;

use scanhub_config::{Config, DEFAULT, Gateway, Sources, Value, values};
use serde_json::{Value as Json, json};
use tempfile::TempPath;

/// A temporary file.
struct TempConfig(TempPath);

impl TempConfig {
    fn new(name: &str, text: &str) -> TempConfig {
        let file = tempfile::Builder::new().suffix(name).tempfile().expect("a file");
        fs::write(&file, text).expect("a writable file");
        TempConfig(file.into_temp_path())
    }

    fn location(&self, line_and_column: &str) -> String {
        format!("{}:{line_and_column}", self.0.display())
    }
}

/// Ports of the default configuration.
const LINKS: [&str; 2] = ["front=/dev/ttyUSB0", "rear=/dev/ttyUSB1"];

fn sources(files: &[&TempConfig], links: &[&str], set: &[&str]) -> Sources {
    let owned = |flags: &[&str]| flags.iter().map(|flag| (*flag).to_owned()).collect();
    Sources {
        files: files.iter().map(|file| file.0.to_path_buf()).collect(),
        links: owned(links),
        set: owned(set),
    }
}

/// Returns the value and the origin of `key`.
fn value_and_source<'a>(values: &'a [Value], key: &str) -> (&'a Json, &'a str) {
    let found: Vec<_> = values.iter().filter(|value| value.key == key).collect();
    let [value] = &found[..] else { panic!("{key}: {found:?}") };
    (&value.value, &value.origin)
}

#[test]
fn reports_the_deciding_source_of_each_value() {
    let first = TempConfig::new(
        "first.toml",
        "[[link]]\nname = \"a\"\nport = \"/dev/x\"\npose = { x = 0.3, yaw = 1.5 }\n[link.zones]\nmargin = 0.05\n\n\
         [[link]]\nname = \"b\"\nport = \"/dev/y\"\nunit = \"cm\"\n\n[gateway]\nttl = 2\nto = [\"10.0.0.7:22200\"]\n",
    );
    let second = TempConfig::new(
        "second.toml",
        "[zones]\nmargin = 0.01\nbody_mask = [{ from_deg = -77.5, to_deg = -60, range = 0.42 }]\n\n[background]\n\
         method = \"off\"\nscans = 100\nstart = \"first-scan\"\n[[link]]\nname = \"a\"\nbaud = 38400\n",
    );
    let links = ["c=file:/tmp/x?rate=max"];
    let set = ["link.a.pose.x=-0.25", "zones.radii=[1.2,0.7]", "link.c.type=lms211", "link.c.mode=0x01"];
    let values = values(&sources(&[&first, &second], &links, &set)).unwrap();
    for (key, value, place) in [
        ("link.a.port", json!("/dev/x"), first.location("3:8")),
        ("link.a.baud", json!(38400), second.location("11:8")),
        ("link.b.baud", Json::Null, "default".to_owned()),
        ("link.a.pose.x", json!(-0.25), "--set link.a.pose.x=-0.25".to_owned()),
        ("link.a.pose.yaw", json!(1.5), first.location("4:25")),
        ("link.b.pose.x", json!(0.0), "default".to_owned()),
        // A value for one link takes precedence over a value for all links, whichever source comes first.
        ("link.a.zones.margin", json!(0.05), first.location("6:10")),
        ("link.b.zones.margin", json!(0.01), second.location("2:10")),
        ("link.b.zones.radii", json!([1.2, 0.7]), "--set zones.radii=[1.2,0.7]".to_owned()),
        (
            "link.a.zones.body_mask",
            json!([{ "from_deg": -77.5, "to_deg": -60.0, "range": 0.42 }]),
            second.location("3:13"),
        ),
        ("link.b.unit", json!("cm"), first.location("11:8")),
        ("link.a.unit", Json::Null, "default".to_owned()),
        ("link.c.port", json!("file:/tmp/x?rate=max"), "--link c=file:/tmp/x?rate=max".to_owned()),
        ("link.c.angle", json!(100), "default of lms211".to_owned()),
        ("link.c.mode", json!(1), "--set link.c.mode=0x01".to_owned()),
        ("link.a.background.method", json!("off"), second.location("6:10")),
        ("link.a.background.scans", json!(100), second.location("7:9")),
        ("link.a.background.threshold_mm", Json::Null, "default".to_owned()),
        ("link.a.background.start", json!("first-scan"), second.location("8:9")),
        ("link.a.marks.max_range_step", json!(0.1), "default".to_owned()),
        ("limits.subscribers", json!(32), "default".to_owned()),
        ("gateway.ttl", json!(2), first.location("14:7")),
        ("gateway.to", json!(["10.0.0.7:22200"]), first.location("15:6")),
        ("gateway.mtu", json!(1372), "default".to_owned()),
    ] {
        assert_eq!(value_and_source(&values, key), (&value, place.as_str()), "{key}");
    }
}

#[test]
fn link_shows_the_keys_of_its_own_family() {
    let settings = ["link.front.family=ld", "link.front.model=ld19", "link.front.beams=300"];
    let values = |set: &[&str]| values(&sources(&[], &LINKS, set)).unwrap();
    let (all, auto) = (values(&settings), values(&settings[..1]));
    let (lms, model) = (values(&["link.rear.angle=180"]), values(&["link.rear.model=ld19"]));
    for (values, key, value, origin) in [
        (&all, "link.front.family", json!("ld"), "--set link.front.family=ld"),
        (&all, "link.front.model", json!("ld19"), "--set link.front.model=ld19"),
        (&all, "link.front.beams", json!(300), "--set link.front.beams=300"),
        (&auto, "link.front.model", json!("auto"), "default"),
        (&auto, "link.front.beams", Json::Null, "default"),
        (&all, "link.rear.family", json!("auto"), "default"),
        (&lms, "link.rear.family", json!("lms"), "follows from other keys"),
        (&lms, "link.rear.baud", Json::Null, "default"),
        (&model, "link.rear.family", json!("ld"), "default of ld19"),
    ] {
        assert_eq!(value_and_source(values, key), (&value, origin), "{key}");
    }
    let top = values(&["link.front.family=rplidar", "link.front.mode=express", "link.front.idle=stop"]);
    assert_eq!(value_and_source(&top, "link.front.mode").0, &json!("express"));
    assert_eq!(value_and_source(&top, "link.front.idle").0, &json!("stop"));
    assert!(all.iter().all(|value| value.key != "link.front.mode" && value.key != "link.front.idle"));
    let lms_keys =
        ["type", "angle", "resolution", "unit", "mode", "baud"].map(|key| format!("link.front.{key}"));
    assert!(all.iter().all(|value| !lms_keys.contains(&value.key) && value.key != "link.rear.model"));
    let set: Vec<String> = all
        .iter()
        .filter(|value| !value.value.is_null())
        .map(|value| format!("{}={}", value.key, value.text()))
        .collect();
    let set: Vec<&str> = set.iter().map(String::as_str).collect();
    assert_eq!(Config::load(&sources(&[], &LINKS, &set)), Config::load(&sources(&[], &LINKS, &settings)));
}

#[test]
fn shown_values_round_trip_as_settings() {
    let settings = [
        "link.front.zones.body_mask=[{from_deg=-1,to_deg=2,range=0.4}]",
        "link.front.unit=cm",
        "limits.subscribers=200",
        "gateway.ttl=3",
    ];
    let of = |set: &[&str]| sources(&[], &LINKS, set);
    let values = values(&of(&settings)).unwrap();
    let set: Vec<String> = values
        .iter()
        .filter(|value| !value.value.is_null())
        .map(|value| format!("{}={}", value.key, value.text()))
        .collect();
    let set: Vec<&str> = set.iter().map(String::as_str).collect();
    assert!(set.len() >= 50, "{set:?}");
    assert_eq!(Config::load(&of(&set)), Config::load(&of(&settings)));
    let gateway = Gateway::of(&of(&set).read()).unwrap();
    assert_eq!((gateway.ttl, gateway.mtu), (Some(3), Some(1372)));
}

#[test]
fn every_key_of_the_page_is_shown() {
    let page = include_str!("../../../docs/configuration.md");
    let example =
        page.split("```toml\n").nth(1).and_then(|rest| rest.split("```").next()).expect("an example");
    let file = TempConfig::new("shown.toml", example);
    let values = values(&sources(&[&file], &[], &[])).unwrap();
    for line in example.lines().filter(|line| !line.starts_with('[') && !line.starts_with("name")) {
        let Some((key, _)) = line.split_once(" = ") else { continue };
        let key = key.trim_start_matches("# ");
        let is_it = |value: &&Value| value.key.split('.').any(|word| word == key);
        assert!(values.iter().any(|value| is_it(&value)), "{key} is not shown");
    }
}

#[test]
fn default_file_has_default_values_and_every_key() {
    let file = TempConfig::new("default.toml", DEFAULT);
    let written = Config::load(&sources(&[&file], &[], &[])).unwrap();
    assert_eq!(written, Config::load(&sources(&[], &LINKS[..1], &[])).unwrap());
    let shown =
        |values: Vec<Value>| -> Vec<_> { values.into_iter().map(|value| (value.key, value.value)).collect() };
    let without = shown(values(&sources(&[], &LINKS[..1], &[])).unwrap());
    assert_eq!(shown(values(&sources(&[&file], &[], &[])).unwrap()), without);
    assert!(DEFAULT.lines().count() <= 100, "more than four screens");
    assert!(DEFAULT.lines().all(|line| line.len() <= 120), "wider than a screen");
    // Every commented-out line is valid, and there is a link of each family.
    let is_key = |line: &str| {
        line.starts_with('[') || line.split_once(" = ").is_some_and(|(key, _)| !key.contains(' '))
    };
    let line = |line: &str| line.strip_prefix("# ").filter(|rest| is_key(rest)).unwrap_or(line).to_owned();
    let all: Vec<String> = DEFAULT.lines().map(line).collect();
    let all = TempConfig::new("all.toml", &all.join("\n"));
    // The file sets every key of the output, for all links or for one link.
    let values = values(&sources(&[&all], &[], &[])).unwrap();
    let of_link = |key: &str| Some(key.strip_prefix("link.")?.split_once('.')?.1.to_owned());
    let key = |value: &Value| of_link(&value.key).unwrap_or_else(|| value.key.clone());
    let (set, unset): (Vec<_>, Vec<_>) =
        values.iter().partition(|value| !value.origin.starts_with("default"));
    let set: Vec<_> = set.into_iter().map(key).collect();
    let unset: Vec<_> = unset.into_iter().map(key).filter(|key| !set.contains(key)).collect();
    assert!(unset.is_empty(), "not in the default file: {unset:?}");
    let all = Config::load(&sources(&[&all], &[], &[])).unwrap();
    let families: Vec<_> = all.links.iter().filter_map(|link| link.family()).collect();
    assert_eq!(families[..3], scanhub_schema::Family::ALL);
    let scanner = &all.links[1].scanner;
    assert!(scanner.settings.expected_type.is_some() && scanner.settings.unit_mm.is_some());
}

#[test]
fn family_implied_by_the_model_names_the_model() {
    let links = ["front=/dev/ttyUSB0,model=ld19", "rear=/dev/ttyUSB1,family=ld,model=ld19"];
    let values = values(&sources(&[], &links, &[])).unwrap();
    assert_eq!(value_and_source(&values, "link.front.family"), (&json!("ld"), "default of ld19"));
    assert_eq!(
        value_and_source(&values, "link.rear.family"),
        (&json!("ld"), "--link rear=/dev/ttyUSB1,family=ld,model=ld19")
    );
}
