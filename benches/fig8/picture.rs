//! A floor plan as SVG, seen from above with the sensor at the bottom: dots in classes, rings, a scale. Small, because dots
//! of one class are one path on a grid of a centimetre; readable on light and on dark pages, because it has no background
//! and no extreme colour. Refuses to know what is drawn.

use std::collections::BTreeSet;
use std::fmt::Write;

use schema::Scan;

/// A place in the frame of the sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Place {
    pub(crate) right_mm: i32,
    pub(crate) ahead_mm: i32,
}

impl Place {
    /// Where beam `i` of `scan` ends if it has this range, in device units.
    pub(crate) fn of(scan: &Scan, i: usize, range: u16) -> Place {
        let mm = f64::from(range) * f64::from(scan.unit_um) / 1000.0;
        let (left, ahead) = scan.angle(i).sin_cos();
        Place { right_mm: (-mm * left).round() as i32, ahead_mm: (mm * ahead).round() as i32 }
    }

    /// On the page: a pixel is a centimetre.
    fn pixel(self) -> (i32, i32) {
        let centimetres = |mm: i32| (f64::from(mm) / 10.0).round() as i32;
        (LEFT + centimetres(self.right_mm), BOTTOM - centimetres(self.ahead_mm))
    }
}

/// A picture that grows.
pub(crate) struct Picture {
    body: String,
    legend: Vec<&'static str>,
    title: &'static str,
}

impl Picture {
    /// An empty one.
    pub(crate) fn new(title: &'static str) -> Picture {
        Picture { body: String::new(), legend: Vec::new(), title }
    }

    /// A dot at each of `places`, in the colour of `class`, one of [`CLASSES`].
    pub(crate) fn dots(&mut self, class: &'static str, places: &[Place]) {
        let pixels: BTreeSet<(i32, i32)> = places.iter().map(|place| place.pixel()).collect();
        let _ = write!(self.body, "<path class=\"{class}\" d=\"");
        let mut pen: Option<(i32, i32)> = None;
        for (x, y) in pixels {
            let _ = match pen {
                None => write!(self.body, "M{x} {y}h0"),
                Some((px, py)) => write!(self.body, "m{} {}h0", x - px, y - py),
            };
            pen = Some((x, y));
        }
        self.body.push_str("\"/>\n");
        self.legend.push(class);
    }

    /// A ring around a thing of `width_mm`.
    pub(crate) fn ring(&mut self, middle: Place, width_mm: u16) {
        let (x, y) = middle.pixel();
        let radius = width_mm / 20 + 9;
        let _ = writeln!(self.body, "<circle class=\"ring\" cx=\"{x}\" cy=\"{y}\" r=\"{radius}\"/>");
    }

    /// The whole text.
    pub(crate) fn finish(self) -> String {
        let (x, y) = (Place { right_mm: 0, ahead_mm: 0 }).pixel();
        let mut text = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" font-family=\"sans-serif\" \
             font-size=\"15\">\n<title>{}</title>\n<style>path{{fill:none;stroke-width:3;stroke-linecap:round}}\
             text{{fill:#808080}}.ring{{fill:none;stroke:#d9534f;stroke-width:1.5}}",
            self.title
        );
        for (class, colour) in CLASSES {
            let _ = write!(text, ".{class}{{stroke:{colour}}}");
        }
        text.push_str("</style>\n");
        text.push_str(&self.body);
        let _ = writeln!(text, "<path d=\"M{} {y}h20l-10 -14z\" fill=\"#808080\"/>", x - 10);
        let _ = writeln!(
            text,
            "<path d=\"M20 {y}h100\" stroke=\"#808080\"/><text x=\"20\" y=\"{}\">1 m</text>",
            y - 8
        );
        let _ = writeln!(text, "<text x=\"20\" y=\"24\">{}</text>", self.title);
        for (row, class) in self.legend.iter().enumerate() {
            let y = 48 + 20 * row as i32;
            let _ = writeln!(
                text,
                "<path class=\"{class}\" d=\"M20 {}h20\"/><text x=\"48\" y=\"{y}\">{class}</text>",
                y - 5
            );
        }
        text.push_str("</svg>\n");
        text
    }
}

/// What dots can be, with their colours.
const CLASSES: [(&str, &str); 4] =
    [("background", "#808080"), ("foreground", "#e67e22"), ("new", "#d9534f"), ("gone", "#3498db")];
/// Size of the page, and where the sensor is on it, in pixels: the room of 6.3 by 5.5 m and the passage behind its door.
const WIDTH: i32 = 760;
const HEIGHT: i32 = 730;
const LEFT: i32 = 350;
const BOTTOM: i32 = 705;
