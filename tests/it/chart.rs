//! The charts of the benches: well-formed whatever the names are, and every value beside the tick of its number.

#[path = "../../benches/support/chart.rs"]
mod plot;

use std::collections::BTreeMap;

use plot::{Chart, Point, Scale, Series};

/// A tag of the picture, with the text right behind it.
struct Element {
    name: String,
    attributes: BTreeMap<String, String>,
    text: String,
}

impl Element {
    fn number(&self, attribute: &str) -> f64 {
        self.attributes[attribute].parse().expect("a number")
    }
}

/// All elements in their order; panics where a tag or a quote stays open, or a character is not escaped.
fn elements(svg: &str) -> Vec<Element> {
    let (mut found, mut open) = (Vec::new(), Vec::new());
    for piece in svg.split('<').skip(1) {
        let (tag, text) = piece.split_once('>').expect("a tag ends");
        assert!(!text.contains('>'), "not escaped: {text}");
        for entity in text.split('&').skip(1) {
            assert!(["amp;", "lt;", "gt;", "quot;"].iter().any(|known| entity.starts_with(known)), "{text}");
        }
        if let Some(name) = tag.strip_prefix('/') {
            assert_eq!(open.pop().as_deref(), Some(name));
            continue;
        }
        let words = tag.trim_end_matches('/');
        let (name, mut rest) = words.split_once(' ').unwrap_or((words, ""));
        let mut attributes = BTreeMap::new();
        while let Some((key, value)) = rest.split_once("=\"") {
            let (value, behind) = value.split_once('"').expect("a quote ends");
            attributes.insert(key.trim().to_owned(), value.to_owned());
            rest = behind;
        }
        assert_eq!(rest.trim(), "", "{tag}");
        if !tag.ends_with('/') {
            open.push(name.to_owned());
        }
        found.push(Element { name: name.to_owned(), attributes, text: text.trim().to_owned() });
    }
    assert_eq!(open, Vec::<String>::new());
    found
}

/// Where the text is that stands for itself.
fn label<'a>(elements: &'a [Element], text: &str, anchor: &str) -> &'a Element {
    let is_it = |element: &&Element| {
        element.text == text && element.attributes.get("text-anchor").is_some_and(|found| found == anchor)
    };
    elements.iter().find(is_it).unwrap_or_else(|| panic!("no {text}"))
}

/// Whether `y` is at the height of the tick, whose text stands 4.5 below it.
fn is_at(elements: &[Element], y: f64, tick: &str) -> bool {
    (label(elements, tick, "end").number("y") - 4.5 - y).abs() < 0.11
}

fn series(name: &str, points: &[(f64, f64)]) -> Series {
    Series { name: name.to_owned(), points: points.iter().map(|&(x, y)| Point::exact(x, y)).collect() }
}

#[test]
fn lines_go_through_their_values() {
    let mut rising = series("rising", &[(1.0, 20.0), (10.0, 40.0), (100.0, 100.0)]);
    rising.points[1] = Point { x: 10.0, y: 40.0, least: 20.0, most: 60.0 };
    let chart = Chart::new("load", "consumers", "%").x(Scale::Log).lines(&[rising]);
    let elements = elements(&chart.svg());
    let dots: Vec<&Element> = elements.iter().filter(|element| element.name == "circle").collect();
    for (dot, (x, y)) in dots.iter().zip([("1", "20"), ("10", "40"), ("100", "100")]) {
        assert!(is_at(&elements, dot.number("cy"), y), "{y}");
        assert!((label(&elements, x, "middle").number("x") - dot.number("cx")).abs() < 0.11, "{x}");
    }
    assert_eq!(dots.len(), 3);
    let bar = elements.iter().find(|element| element.attributes.get("d").is_some_and(|d| d.contains("h8M")));
    let d = &bar.expect("the spread of one point").attributes["d"];
    let (low, high) = d.split_once(' ').and_then(|(_, rest)| rest.split_once('V')).expect("a line upwards");
    assert!(is_at(&elements, low.parse().expect("a number"), "20"));
    assert!(is_at(&elements, high.split('m').next().expect("a number").parse().expect("a number"), "60"));
    assert!(is_at(&elements, 340.0, "0"), "a linear axis begins at zero");
}

#[test]
fn a_logarithmic_axis_has_equal_steps_and_keeps_zero_at_its_end() {
    let falling = series("", &[(0.0, 0.001), (1.0, 0.1), (2.0, 10.0), (3.0, 0.0)]);
    let elements = elements(&Chart::new("", "", "").y(Scale::Log).lines(&[falling]).svg());
    let dots: Vec<f64> =
        elements.iter().filter(|element| element.name == "circle").map(|dot| dot.number("cy")).collect();
    assert!(((dots[0] - dots[1]) - (dots[1] - dots[2])).abs() < 0.21, "{dots:?}");
    assert!(is_at(&elements, dots[1], "0.1"));
    assert_eq!(dots[3], 340.0);
}

#[test]
fn bars_stand_upon_each_other() {
    let user = series("user", &[(0.0, 1.0), (1.0, 2.0)]);
    let system = series("system", &[(0.0, 1.0), (1.0, 3.0)]);
    let elements = elements(&Chart::new("", "", "").bars(&["10\nall", "100"], &[user, system]).svg());
    let bars: Vec<(f64, f64)> = elements
        .iter()
        .filter(|element| element.name == "rect" && element.text.is_empty())
        .filter(|element| element.attributes["width"] != "18")
        .map(|bar| (bar.number("y"), bar.number("y") + bar.number("height")))
        .collect();
    for (bar, (high, low)) in bars.iter().zip([("1", "0"), ("2", "0"), ("2", "1"), ("5", "2")]) {
        assert!(
            is_at(&elements, bar.0, high) && is_at(&elements, bar.1, low),
            "{bar:?} is not {low} to {high}"
        );
    }
    assert_eq!(bars.len(), 4);
    label(&elements, "all", "middle");
}

#[test]
fn no_name_breaks_the_picture() {
    let name = "a < b & \"c\" > d";
    for chart in [
        Chart::new(name, name, name).lines(&[series(name, &[(1.0, 1.0)])]),
        Chart::new(name, name, name).bars(&[name], &[series(name, &[(0.0, 0.0)])]),
        Chart::new(name, name, name).y(Scale::Log).lines(&[]),
    ] {
        let svg = chart.svg();
        elements(&svg);
        assert!(svg.contains("a &lt; b &amp; &quot;c&quot; &gt; d"));
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
