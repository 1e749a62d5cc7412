//! Tests of site files: their contents, and the error for each mistake.

use scanhub_perception::track::Site;
use scanhub_schema::Kind;

const HOUSE: &str = r#"
[[sensor]]
name = "front"
pose = { x = 0.0, y = 2.0, yaw = 0.0 }

[[sensor]]
name = "kitchen.rear"
pose = { x = 13.0, y = 2.0, yaw = 3.1416 }

[[room]]
name = "hall"
polygon = [[0, 0], [5, 0], [5, 4], [0, 4]]

[[room]]
name = "corridor"
polygon = [[5, 1], [8, 1], [8, 3], [5, 3]]

[[room]]
name = "kitchen"
polygon = [[8, 0], [13, 0], [13, 4], [8, 4]]

[[door]]
name = "left"
from = "hall"
to = "corridor"
between = [[5, 1.5], [5, 2.5]]

[[door]]
name = "right"
from = "corridor"
to = "kitchen"
between = [[8, 1.5], [8, 2.5]]

[[gap]]
between = ["left", "right"]
seconds = [2, 15]

[[ignore]]
name = "fountain"
polygon = [[2, 1], [3, 1], [3, 2]]
"#;

#[test]
fn parses_the_house_site_file() {
    let site = Site::parse("house.toml", HOUSE).unwrap();
    assert_eq!((site.sensors.len(), site.rooms.len(), site.doors.len(), site.gaps.len()), (2, 3, 2, 1));
    assert_eq!((site.sensors[0].hub(), site.sensors[1].hub()), ("", "kitchen"));
    assert_eq!(site.rooms_with_sensor(), [true, false, true]);
    assert_eq!((site.room_at([6.0, 2.0]), site.room_at([6.0, 3.5])), (Some(1), None));
    assert_eq!((site.doors[1].from, site.doors[1].to), (Some(1), Some(2)));
    assert_eq!((site.is_ignored([2.9, 1.5]), site.is_ignored([2.1, 1.5])), (true, false));
}

#[test]
fn each_site_error_has_a_location_and_a_remedy() {
    let cases: &[(&str, &str, &str, &str)] = &[
        ("yaw = 0.0 }", "yaw = 0.0, z = 1.0 }", "house.toml:4:39: unknown key `z`", "Known here: x, y, yaw"),
        ("\"kitchen.rear\"", "\"front\"", "house.toml:7:8: sensor \"front\" twice", "another name"),
        ("\"kitchen.rear\"", "\"a.b.c\"", "house.toml:7:8: sensor name", "1 to 24"),
        (
            "to = \"corridor\"",
            "to = \"coridor\"",
            "door left: no room \"coridor\"",
            "did you mean `corridor`?",
        ),
        ("[[5, 1], [8, 1]", "[[4.5, 1], [8, 1]", "rooms hall and corridor overlap", "--svg"),
        ("[[5, 1.5], [5, 2.5]]", "[[3, 1.5], [3, 2.5]]", "door left: 2.00 m from the walls", "at most 0.5 m"),
        (
            "to = \"corridor\"",
            "to = \"hall\"",
            "door left: both sides are \"hall\"",
            "from one room to another",
        ),
        ("from = \"hall\"\n", "", "house.toml:22:1: missing field `from`", "docs/tracks.md"),
        (
            "from = \"hall\"\nto = \"corridor\"",
            "from = \"outside\"\nto = \"outside\"",
            "door left: both sides are \"outside\"",
            "from one room to another",
        ),
        (
            "from = \"hall\"\nto = \"corridor\"",
            "from = \"attic\"\nto = \"cellar\"",
            "door left: no room \"attic\"",
            "Rooms here: hall, corridor, kitchen, outside",
        ),
        ("seconds = [2, 15]", "seconds = [15, 2]", "seconds 15 to 2", "[2, 15]"),
        ("\"left\", \"right\"", "\"left\", \"rigth\"", "gap: no door \"rigth\"", "did you mean `right`?"),
        ("[5, 4], [0, 4]", "[0, 4], [5, 4]", "room hall: its sides cross", "in their order"),
        ("x = 0.0,", "x = 2000.0,", "2000 m is too far", "at most 1000"),
        ("yaw = 0.0", "yaw = 90.0", "yaw 90 of sensor front", "radians"),
        (
            "[3, 1], [3, 2]]",
            "[3, 1]]",
            "house.toml:40:11: ignored area fountain: 2 corners",
            "at least three",
        ),
        (
            "[2, 1], [3, 1], [3, 2]",
            "[2, 1], [3, 2], [3, 1], [2, 2]",
            "house.toml:40:11: ignored area fountain: its sides cross",
            "in their order",
        ),
        (
            "[3, 1], [3, 2]]",
            "[3, 1], [3, 1.01]]",
            "house.toml:40:11: ignored area fountain: 0.005 m2",
            "at least 0.02 m2",
        ),
        ("[[2, 1], [3, 1], [3, 2]]", "[[2, 7], [3, 7], [3, 8]]", "fountain is in no room", "--svg"),
        (
            "[[2, 1], [3, 1], [3, 2]]",
            "[[-1, -1], [6, -1], [6, 5], [-1, 5]]",
            "ignored area fountain covers room hall",
            "smaller",
        ),
        ("[2, 1], [3, 1]", "[2000, 1], [3, 1]", "house.toml:40:11: 2000 m is too far", "at most 1000"),
        ("\"fountain\"", "\"\"", "house.toml:39:8: ignored area name \"\" is not possible", "1 to 24"),
        ("polygon = [[2,", "corners = [[2,", "unknown key `corners`", "did you mean"),
        (
            "[[gap]]",
            "[[room]]\nname = \"attic\"\npolygon = [[0, 9], [3, 9], [3, 12]]\n[[gap]]",
            "room attic cannot be reached",
            "add [[door]]",
        ),
    ];
    for (right, wrong, what, remedy) in cases {
        assert!(HOUSE.contains(right), "{right}");
        let failure = Site::parse("house.toml", &HOUSE.replacen(right, wrong, 1)).unwrap_err();
        assert_eq!(failure.kind, Kind::Configuration);
        assert!(failure.message.starts_with("house.toml"), "{failure}");
        assert!(failure.message.contains(what), "{wrong}: {failure}");
        assert!(failure.hint.contains(remedy), "{wrong}: {failure}");
    }
    for (text, what) in [("", "no sensor"), ("[[sensor]]\nname = \"a\"\npose = {x=0,y=0,yaw=0}", "no room")] {
        assert!(Site::parse("f", text).unwrap_err().message.contains(what));
    }
    assert_eq!(Site::read(std::path::Path::new("/nonexistent")).unwrap_err().kind, Kind::Input);
}

#[test]
fn drawing_shows_everything_in_the_site_file() {
    let svg = Site::parse("house.toml", &HOUSE.replace("kitchen\"", "<&\"")).unwrap().svg();
    for word in [
        "front",
        "kitchen.rear",
        "hall",
        "corridor",
        "no sensor",
        "left",
        "right",
        "2 to 15 s",
        "&lt;&amp;",
        "fountain",
    ] {
        assert!(svg.contains(word), "{word}");
    }
    assert_eq!(svg.matches("<polygon").count(), 4);
    assert_eq!(svg.matches("stroke-dasharray=\"4 4\"").count(), 1, "the ignored area is dashed");
    assert_eq!(svg.matches("<circle").count(), 2);
}
