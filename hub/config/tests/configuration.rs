//! Tests of merging: which source takes precedence, which values are rejected, and that each error states place, value
//! and remedy.

use scanhub_drivers::features;
use std::fs;

use scanhub_config::{Config, Gateway, Processing, Sources};
use scanhub_preprocess::background::{Candidate, Method, Start};
use scanhub_preprocess::zones::Sector;
use scanhub_schema::{Background, BackgroundHead, Family, Kind, as_json};
use tempfile::TempPath;

/// A temporary file.
struct TempConfig(TempPath);

impl TempConfig {
    fn new(name: &str, text: impl AsRef<[u8]>) -> TempConfig {
        let file = tempfile::Builder::new().suffix(name).tempfile().expect("a file");
        fs::write(&file, text).expect("a writable file");
        TempConfig(file.into_temp_path())
    }
}

/// Links for tests whose configuration files have no links.
const LINKS: [&str; 2] = ["front=/dev/ttyUSB0,family=lms", "rear=/dev/ttyUSB1,family=lms"];

fn load(files: &[&TempConfig], set: &[&str]) -> Result<Config, String> {
    let sources = Sources {
        files: files.iter().map(|file| file.0.to_path_buf()).collect(),
        set: set.iter().map(|flag| (*flag).to_owned()).collect(),
        links: if files.is_empty() { LINKS.map(str::to_owned).into() } else { Vec::new() },
    };
    Config::load(&sources).map_err(|failure| {
        assert_eq!(failure.kind, Kind::Configuration);
        failure.to_string()
    })
}

fn processing(files: &[&TempConfig], set: &[&str], link: usize) -> Processing {
    load(files, set).unwrap().links[link].processing.clone()
}

#[test]
fn example_on_the_page_has_the_documented_effect() {
    let page = include_str!("../../../docs/configuration.md");
    let example =
        page.split("```toml\n").nth(1).and_then(|rest| rest.split("```").next()).expect("an example");
    let file = TempConfig::new("page.toml", example);
    let config = load(&[&file], &[]).unwrap();
    let [front, rear, side, top] = &config.links[..] else { panic!("{config:?}") };
    assert_eq!((front.processing.pose.x_m, rear.processing.pose.upside_down), (0.3, 1));
    assert_eq!(front.processing.zones.body_mask.len(), 1);
    assert_eq!(front.processing.zones.margin_mm, 50);
    let set = &side.scanner.settings;
    assert_eq!((side.family(), set.model, set.beams), (Some(Family::Ld), Some("ld19"), Some(450)));
    let set = &top.scanner.settings;
    assert_eq!(
        (top.family(), top.scanner.is_auto(), set.mode, set.stop_when_idle),
        (Some(Family::Rplidar), true, None, false)
    );
    // The default configuration shows the default values. The sections of the first link change the values, so compare
    // with the second link.
    let Processing { zones, marks, lines, background, early, .. } = Processing::default();
    let shown = &rear.processing;
    assert_eq!((&shown.zones, shown.marks, &shown.background), (&zones, marks, &background));
    assert_eq!(shown.lines, lines);
    assert_eq!(shown.early, early);
}

/// Every family has a section in the output of `config default`. All sections except the first are comments.
#[test]
fn default_has_a_section_for_each_family() {
    let is_setting = |line: &&str| *line == "[[link]]" || line.contains(" = ");
    let all: Vec<&str> = scanhub_config::DEFAULT
        .lines()
        .map(|line| line.strip_prefix("# ").filter(is_setting).unwrap_or(line))
        .collect();
    let file = TempConfig::new("default.toml", all.join("\n"));
    let config = load(&[&file], &[]).unwrap_or_else(|refusal| panic!("{refusal}"));
    let families: Vec<Family> = config.links.iter().filter_map(scanhub_config::Link::family).collect();
    // The last link is a recording.
    assert_eq!(families.split_last().map(|(_, live)| live), Some(&Family::ALL[..]));
    for features in Family::ALL.into_iter().map(features) {
        let names = features.models.iter().map(|model| model.name).chain(features.modes.iter().copied());
        for name in names {
            assert!(scanhub_config::DEFAULT.contains(name), "{name} is missing");
        }
    }
}

#[test]
fn refused_scanner_model_has_its_location() {
    let file = TempConfig::new(
        "family.toml",
        "[[link]]\nname = \"a\"\nport = \"x\"\nfamily = \"ld\"\nmodel = \"ld20\"\n",
    );
    let refusal = load(&[&file], &[]).unwrap_err();
    assert!(refusal.contains("family.toml:5:9: link a: model = \"ld20\""), "{refusal}");
}

#[test]
fn link_settings_and_later_sources_take_precedence() {
    let first = TempConfig::new(
        "first.toml",
        "[[link]]\nname = \"a\"\nport = \"/dev/x\"\npose = { x = 0.3, yaw = 1.5 }\n\
         [link.zones]\nmargin = 0.05\n\n[[link]]\nname = \"b\"\nport = \"/dev/y\"\n",
    );
    let second = TempConfig::new(
        "second.toml",
        "[zones]\nmargin = 0.01\nradii = [2.0]\nbody_mask = [{ from_deg = -77.5, to_deg = -60, range = 0.42 }]\n\
         [background]\nmethod = \"paper\"\ncandidate = \"latest\"\nthreshold_mm = 40\nscans = 100\n\
         publish = \"every-scan\"\nstart = \"first-scan\"\n[marks]\nmax_range_step = 0.2\nmin_level = 2\nmax_gap = 1\n\
         [lines]\nmax = 20\nrefine = true\n[motion]\nmax_step = 0.8\n",
    );
    let set = ["link.a.pose.x=-0.25", "link.a.pose.upside_down=true", "zones.radii=[1.2,0.7]"];
    let set = [
        &set[..],
        &[
            "link.b.background.method=off",
            "link.b.zones.exact=false",
            "link.b.lines.min_points=9",
            "link.b.motion.max_turn=40",
        ],
    ]
    .concat();
    let [a, b] = [0, 1].map(|link| processing(&[&first, &second], &set, link));
    assert_eq!((a.pose.x_m, a.pose.y_m, a.pose.yaw_rad, a.pose.upside_down), (-0.25, 0.0, 1.5, 1));
    assert_eq!((a.zones.margin_mm, b.zones.margin_mm), (50, 10));
    assert_eq!((&a.zones.radii_mm, &b.zones.radii_mm), (&vec![1200, 700], &vec![1200, 700]));
    assert_eq!(a.zones.body_mask, [Sector { from_mdeg: -77_500, to_mdeg: -60_000, range_mm: 420 }]);
    assert_eq!((a.zones.exact, b.zones.exact), (true, false));
    let learning = a.background.learning;
    assert_eq!(
        (learning.method, learning.candidate, learning.start),
        (Method::Paper, Candidate::Latest, Start::FirstScan)
    );
    assert_eq!((learning.threshold_mm, learning.candidate_mm, learning.scans), (Some(40), None, Some(100)));
    assert_eq!(
        (a.background.is_enabled, b.background.is_enabled, a.background.every_scan),
        (true, false, true)
    );
    assert_eq!((a.marks.max_range_step_mm, a.marks.min_level, a.marks.max_gap), (200, 2, 1));
    assert_eq!((a.lines.max, a.lines.min_points, a.lines.refine), (20, 5, true));
    assert_eq!((a.motion.max_step_m, a.motion.max_turn_deg, a.motion.min_overlap), (0.8, 30.0, 0.4));
    assert_eq!((b.motion.max_step_m, b.motion.max_turn_deg), (0.8, 40.0));
    assert_eq!((b.lines.max, b.lines.min_points, b.lines.refine), (20, 9, true));
}

#[test]
fn refused_setting_has_location_value_and_remedy() {
    for (setting, words) in [
        ("link.front.pose.x=nan", "x = NaN\n  meters"),
        ("link.front.pose=[1, 2]", "pose is a list\n  write it as [pose]"),
        ("link.front.pose.y=300", "y = 300\n  meters from the robot's center, at most 100"),
        ("link.front.pose.yaw=90", "yaw = 90\n  radians, counterclockwise: 90 degrees are 1.5708"),
        (
            "link.front.pose.yam=1",
            "unknown key `yam`\n  did you mean `yaw`? Known here: x, y, yaw, upside_down",
        ),
        ("link.front.pose.upside_down=1", "upside_down = 1 is not a switch\n  "),
        ("link.front.pose.x=left", "x = \"left\" is not a number\n  see docs"),
        ("link.front.zones.radi=[1]", "unknown key `radi`\n  did you mean `radii`?"),
        ("zones.radii=[0.6,1.0]", "radii = [0.6, 1.0]\n  the largest first"),
        ("zones.radii=[1.0,1.0]", "the largest first, each once"),
        ("zones.radii=[]", "1 to 8 radii"),
        ("zones.radii=[9,8,7,6,5,4,3,2,1]", "1 to 8 radii"),
        ("zones.radii=[1.0,0]", "more than 0 and at most 65"),
        ("zones.radii=[1000]", "more than 0 and at most 65"),
        ("zones.radii=1.0", "radii = 1.0 is not a list\n  zones.radii = [1.0], with brackets"),
        ("zones.margin=-0.1", "margin = -0.1\n  meters, from 0 to 10"),
        ("zones.max_invalid=10", "max_invalid = 10\n  a share from 0 to 1"),
        ("zones.max_invalid=nan", "max_invalid = NaN"),
        ("zones.min_beams=0", "min_beams = 0\n  a whole number from 1 to 8192"),
        ("zones.min_scans=1.5", "min_scans = 1.5 is not a whole number\n  see docs"),
        ("zones.body_mask=[{from_deg=30,to_deg=12,range=0.4}]", "from before to"),
        (
            "zones.body_mask=[{from_deg=-181,to_deg=12,range=0.4}]",
            "body_mask = { from_deg = -181, to_deg = 12, range = 0.4 }\n  from_deg and to_deg are",
        ),
        ("zones.body_mask=[{from_deg=-1,to_deg=180.5,range=0.4}]", "0 ahead, 90 left, -90 right"),
        (
            "zones.body_mask=[{from=100.1,to=120,range=0.4}]",
            "body_mask = { from = 100.1, to = 120, range = 0.4 } counts angles from the right\n  angles are counted from \
             ahead now: { from_deg = 10.1, to_deg = 30.0, range = 0.4 }",
        ),
        ("zones.body_mask=[{from=0,to=20,range=1}]", "{ from_deg = -90.0, to_deg = -70.0, range = 1.0 }"),
        ("zones.body_mask=[{from_deg=1,to=20,range=1}]", "without its two angles\n  give it both"),
        ("zones.body_mask=[{range=1}]", "without its two angles"),
        ("zones.body_mask=[{from_deg=1,to_deg=12,range=0}]", "range is in meters"),
        ("zones.body_mask=[{from_deg=1,to_deg=12,rang=1}]", "unknown key `rang`\n  did you mean `range`?"),
        ("zonse.margin=1", "unknown key `zonse`\n  did you mean `zones`?"),
        ("marks.min_level=8", "min_level = 8\n  a whole number from 1 to 7"),
        ("marks.level=0", "level = 0\n  a whole number from 1 to 65535"),
        (
            "link.front.marks.level=200",
            "level, but the intensities of an lms are reflector levels, 0 to 7\n  use min_level",
        ),
        ("marks.max_range_step=100", "max_range_step = 100\n  meters"),
        ("marks.max_gap=-1", "max_gap = -1"),
        ("lines.max=65", "max = 65\n  a whole number from 1 to 64"),
        ("motion.max_step=0", "max_step = 0\n  meters from scan to scan, from 0.01 to 10"),
        ("motion.max_turn=90", "max_turn = 90\n  degrees from scan to scan, from 1 to 85"),
        ("motion.min_overlap=0", "min_overlap = 0\n  a share from 0.1 to 1"),
        ("lines.min_points=2", "min_points = 2\n  a whole number from 3 to 8192"),
        (
            "background.method=mult",
            "`mult`\n  did you mean `multi`? Possible here: multi, paper, moving, off",
        ),
        ("background.threshold_mm=0", "threshold_mm = 0\n  a whole number from 1 to 10000"),
        ("background.scans=-4", "scans = -4"),
        ("background.publish=always", "`always`\n  did you mean"),
        (
            "background.start=first_scan",
            "=first_scan: link front: background.start = first_scan: No such file",
        ),
        ("background.start=\"\"", "start = \"\""),
    ] {
        let refusal = load(&[], &[setting]).expect_err(setting);
        assert!(refusal.contains(words), "{setting}: {refusal}");
        assert!(refusal.starts_with(&format!("--set {setting}: ")), "{refusal}");
    }
    let many = vec!["{ from_deg = 1, to_deg = 2, range = 1 }"; 65].join(",");
    let refusal = load(&[], &[&format!("zones.body_mask=[{many}]")]).unwrap_err();
    assert!(refusal.contains("body_mask has 65 sectors\n  at most 64"), "{refusal}");
    let deep =
        TempConfig::new("deep.toml", "[[link]]\nname = \"a\"\nport = \"x\"\n[link.marks]\nmin_levle = 1\n");
    let refusal = load(&[&deep], &[]).unwrap_err();
    assert!(
        refusal.contains("deep.toml:5:1: unknown key `min_levle`\n  did you mean `min_level`?"),
        "{refusal}"
    );
    let nowhere = "[[link]]\nname = \"a\"\nport = \"x\"\n[background]\nstart = \"/nope.json\"\n";
    let nowhere = TempConfig::new("nowhere.toml", nowhere);
    let refusal = load(&[&nowhere], &[]).unwrap_err();
    assert!(
        refusal.contains("nowhere.toml:5:9: link a: background.start = /nope.json: No such"),
        "{refusal}"
    );
    let place = TempConfig::new(
        "place.toml",
        "[[link]]\nname = \"a\"\nport = \"x\"\n[zones]\nmargin = 0.1\nradii = [0.6, 1.0]\n",
    );
    let refusal = load(&[&place], &[]).unwrap_err();
    assert!(refusal.contains("place.toml:6:9: radii = [0.6, 1.0]"), "{refusal}");
}

#[test]
fn zone_that_no_beam_can_see_is_refused() {
    let set = |settings: &[&str]| load(&[], settings).map(drop);
    let refused = |settings: &[&str], words: &str| {
        let refusal = set(settings).expect_err("must be refused");
        assert!(refusal.contains(words), "{settings:?}: {refusal}");
    };
    assert_eq!(set(&["link.front.zones.min_beams=361"]), Ok(()));
    refused(
        &["zones.min_beams=362"],
        "--set zones.min_beams=362: link front: min_beams = 362, but a scan has 361 beams\n  the default is one beam",
    );
    refused(
        &["zones.min_beams=300", "link.rear.resolution=1"],
        "link rear: min_beams = 300, but a scan has 181",
    );
    // The sensor is two meters ahead of the center and faces away from the circle. If the sensor is turned by 180
    // degrees, it sees 30 degrees of the circle, which is 61 beams.
    let facing_away = "link.front.pose.x=2";
    refused(
        &[facing_away, "link.front.pose.y=0"],
        "--set link.front.pose.y=0: link front: no beam sees into the circle of 1 m\n  correct the sensor's pose, or set a \
         circle that it sees: link.front.zones.radii",
    );
    assert_eq!(set(&[facing_away, "link.front.zones.radii=[2.5,1]"]), Ok(()));
    let back = [facing_away, "link.front.pose.yaw=3.1416", "link.front.zones.min_beams=100"];
    assert_eq!(set(&back), Ok(()));
    refused(
        &[&back[..], &["zones.radii=[0.5]"]].concat(),
        "min_beams = 100, but only 57 beams see the circle of 0.5 m\n  set fewer",
    );
    // The maximum range in units of 1 mm is 32 m.
    let far = ["link.front.pose.x=40", "link.front.pose.yaw=3.1416"];
    assert_eq!(set(&far), Ok(()));
    refused(&[&far[..], &["link.front.unit=mm"]].concat(), "no beam sees into the circle of 1 m");
    let body = |range: &str| format!("link.rear.zones.body_mask=[{{from_deg=-90,to_deg=90,range={range}}}]");
    assert_eq!(set(&[&body("0.99")]), Ok(()));
    refused(
        &[&body("1.0")],
        "link rear: body_mask covers every beam up to the circle of 1 m\n  shorten body_mask",
    );
    let file = TempConfig::new(
        "away.toml",
        "[[link]]\nname = \"a\"\nport = \"x\"\nangle = 180\n[link.pose]\nyaw = 0.1\nx = 2\n",
    );
    let refusal = load(&[&file], &[]).unwrap_err();
    assert!(refusal.contains("away.toml:7:5: link a: no beam sees into the circle of 1 m"), "{refusal}");
}

#[test]
fn start_background_must_belong_to_the_sensor() {
    let head = BackgroundHead {
        first_angle: -90_f64.to_radians(),
        step: 0.5_f64.to_radians(),
        unit_um: 1000,
        known_beams: 1,
        ..BackgroundHead::default()
    };
    let mut model = Background::of(head, &[0; 361]);
    model.ranges_mut()[7] = 1234;
    let text = serde_json::to_string(&as_json("front", &model)).unwrap();
    let file = TempConfig::new("model.json", &text);
    let start = format!("link.front.background.start={}", file.0.display());
    let started = processing(&[], &[&start], 0).background;
    assert_eq!((started.model.as_deref(), started.learning.start), (Some(&*model), Start::Empty));
    assert_eq!(processing(&[], &[&start, "link.front.background.start=empty"], 0).background.model, None);
    // The file is ignored if the hub learns no background.
    assert!(load(&[], &[&start, "background.method=off"]).is_ok());

    let name = file.0.display().to_string();
    let refusal = load(&[], &[&format!("link.rear.background.start={name}")]).unwrap_err();
    assert!(refusal.contains(&format!("start = {name}: the model is that of sensor front")), "{refusal}");
    let refusal = load(&[], &[&start, "link.front.resolution=1"]).unwrap_err();
    assert!(refusal.contains("the model has 361 beams in units of 1 mm"), "{refusal}");
    assert!(refusal.contains("configured for 181 beams"), "{refusal}");
    let refusal = load(&[], &[&start, "link.front.unit=cm"]).unwrap_err();
    assert!(refusal.contains("361 beams in units of 10 mm"), "{refusal}");
    let cut = TempConfig::new("cut.json", &text[..900]);
    let refusal = load(&[], &[&format!("link.front.background.start={}", cut.0.display())]).unwrap_err();
    assert!(refusal.contains(": link front: background.start: "), "{refusal}");
    assert!(refusal.contains("cut.json is not a background model: it is cut short"), "{refusal}");
}

#[test]
fn topics_have_configured_number_of_subscriber_slots() {
    let places = |set: &[&str]| load(&[], set).map(|config| config.limits.subscribers);
    assert_eq!(places(&[]), Ok(32));
    for (set, subscribers) in [("limits.subscribers=1", 1), ("limits.subscribers=250", 250)] {
        assert_eq!(places(&[set]), Ok(subscribers));
    }
    let file =
        TempConfig::new("limits.toml", "[limits]\nsubscribers = 40\n[[link]]\nname = \"a\"\nport = \"x\"\n");
    let of_file = |set: &[&str]| load(&[&file], set).map(|config| config.limits.subscribers);
    assert_eq!((of_file(&[]), of_file(&["limits.subscribers=50"])), (Ok(40), Ok(50)));
    for (set, message) in [
        ("limits.subscribers=0", "subscribers = 0\n  1 to 250"),
        ("limits.subscribers=251", "subscribers = 251\n  1 to 250"),
        ("limits.subscribers=-1", "subscribers = -1\n  1 to 250"),
        ("limits.subscriber=1", "did you mean `subscribers`?"),
    ] {
        let error = places(&[set]).unwrap_err();
        assert!(error.starts_with(&format!("--set {set}: ")) && error.contains(message), "{error}");
    }
}

#[test]
fn old_names_are_errors_that_state_the_new_names() {
    for (old, new) in [
        ("[zones]\nself_min = []", "zones.body_mask"),
        ("[marks]\ni_min = 2", "marks.min_level"),
        ("[lines]\npolish = true", "lines.refine"),
        ("[limits]\nconsumers = 40", "limits.subscribers"),
        ("[link.zones]\nself_min = []", "zones.body_mask"),
    ] {
        let file = TempConfig::new("old.toml", format!("[[link]]\nname = \"a\"\nport = \"x\"\n{old}\n"));
        let error = load(&[&file], &[]).unwrap_err();
        let key = old.split(['\n', ' ']).nth(1).unwrap();
        let expected = format!("old.toml:5:1: unknown key `{key}`\n  its new name is `{new}`");
        assert!(error.contains(&expected), "{error}");
    }
    let elsewhere = load(&[], &["zones.polish=true"]).unwrap_err();
    assert!(elsewhere.contains("did you mean"), "{elsewhere}");
}

#[test]
fn gateway_has_a_section_that_needs_no_links() {
    let first = TempConfig::new(
        "gateway-1.toml",
        "[gateway]\ninterface = \"eth0\"\nttl = 2\nkey_file = \"/k\"\ntopics = [\"a/scan\"]\n",
    );
    let second = TempConfig::new("gateway-2.toml", "[gateway]\nbackground_every = \"10s\"\ntopics = []\n");
    let gateway = |files: &[&TempConfig], set: &[&str]| {
        let sources = Sources {
            files: files.iter().map(|file| file.0.to_path_buf()).collect(),
            set: set.iter().map(|flag| (*flag).to_owned()).collect(),
            links: Vec::new(),
        };
        let sources = sources.read();
        let gateway = Gateway::of(&sources).map_err(|failure| failure.to_string())?;
        Ok::<_, String>((gateway, Gateway::background_every_location(&sources)))
    };
    let place = format!("{}:2:20", second.0.display());
    assert_eq!(
        gateway(&[&first, &second], &["gateway.ttl=3", "gateway.bare=true"]).unwrap(),
        (
            Gateway {
                interface: Some("eth0".into()),
                topics: Some(Vec::new()),
                to: None,
                bare: Some(true),
                key_file: Some("/k".into()),
                ttl: Some(3),
                background_every: Some("10s".into()),
                mtu: None,
            },
            Some(place)
        )
    );
    assert_eq!(gateway(&[], &[]).unwrap(), (Gateway::default(), None));
    // A hub can read the same file, together with a file that has links.
    let links = TempConfig::new("gateway-links.toml", "[[link]]\nname = \"a\"\nport = \"x\"\n");
    assert_eq!(load(&[&first, &links], &[]).unwrap().links.len(), 1);
    for (set, message) in [
        ("gateway.ttl=256", "ttl = 256\n  0 to 255"),
        ("gateway.mtu=575", "mtu = 575\n  576 to 1472"),
        ("gateway.mtu=-1", "mtu = -1"),
        ("gateway.tll=1", "did you mean `ttl`?"),
    ] {
        let error = gateway(&[], &[set]).unwrap_err();
        assert!(error.starts_with(&format!("--set {set}: ")) && error.contains(message), "{error}");
    }
}
