//! The plan as SVG, for `scanhub site check`. Refuses to know whether it is right.

use std::fmt::Write;

use scanhub_schema::Printable;

use super::Site;
use crate::track::geometry::{Point, middle};

/// Pixels per metre.
const SCALE: f64 = 60.0;
/// Metres around the plan.
const MARGIN_M: f64 = 0.8;

impl Site {
    /// Returns a drawing: rooms with their names, ignored areas, doors, gaps, and sensors with the way that they look. One
    /// meter is 60 pixels; y is up.
    pub fn svg(&self) -> String {
        let corners = self.rooms.iter().flat_map(|room| room.polygon.iter().copied());
        let corners = corners.chain(self.ignored.iter().flat_map(|area| area.polygon.iter().copied()));
        let points: Vec<Point> = corners.chain(self.sensors.iter().map(|sensor| sensor.place)).collect();
        let least = |axis: usize| points.iter().map(|p| p[axis]).fold(f64::INFINITY, f64::min) - MARGIN_M;
        let most = |axis: usize| points.iter().map(|p| p[axis]).fold(f64::NEG_INFINITY, f64::max) + MARGIN_M;
        let (left, top) = (least(0), most(1));
        let (width, height) = (SCALE * (most(0) - left), SCALE * (top - least(1)));
        let at = |point: Point| (SCALE * (point[0] - left), SCALE * (top - point[1]));
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width:.0} {height:.0}\" \
             font-family=\"sans-serif\" font-size=\"13\">\n\
             <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n"
        );
        let text = |svg: &mut String, point: Point, down: f64, colour: &str, words: &str| {
            let (x, y) = at(point);
            // XML has no control characters, not even escaped ones.
            let words = Printable(words).to_string().replace(['\n', '\u{FFFE}', '\u{FFFF}'], "?");
            let words = words.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
            let _ = writeln!(
                svg,
                "<text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\" fill=\"{colour}\">{words}</text>",
                y + down
            );
        };
        let polygon = |svg: &mut String, corners: &[Point], style: &str| {
            let corners: Vec<String> =
                corners.iter().map(|&p| at(p)).map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
            let _ = writeln!(svg, "<polygon points=\"{}\" {style}/>", corners.join(" "));
        };
        for (room, watched) in self.rooms.iter().zip(self.watched()) {
            let fill = if watched { "#e6eef7" } else { "#eeeeee" };
            let style = format!("fill=\"{fill}\" stroke=\"#333333\" stroke-width=\"3\"");
            polygon(&mut svg, &room.polygon, &style);
            text(&mut svg, center(&room.polygon), 0.0, "#333333", &room.name);
            if !watched {
                text(&mut svg, center(&room.polygon), 16.0, "#777777", "no sensor");
            }
        }
        for area in &self.ignored {
            let style = "fill=\"#777777\" fill-opacity=\"0.2\" stroke=\"#777777\" stroke-width=\"2\" \
                         stroke-dasharray=\"4 4\"";
            polygon(&mut svg, &area.polygon, style);
            text(&mut svg, center(&area.polygon), 4.0, "#777777", &area.name);
        }
        let line = |svg: &mut String, [a, b]: [Point; 2], style: &str| {
            let ((x1, y1), (x2, y2)) = (at(a), at(b));
            let _ =
                writeln!(svg, "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" {style}/>");
        };
        for gap in &self.gaps {
            let ends = gap.doors.map(|door| middle(self.doors[door].between));
            line(&mut svg, ends, "stroke=\"#b35c00\" stroke-width=\"2\" stroke-dasharray=\"6 5\"");
            let words = format!("{} to {} s", gap.seconds[0], gap.seconds[1]);
            text(&mut svg, middle(ends), -8.0, "#b35c00", &words);
        }
        for door in &self.doors {
            line(&mut svg, door.between, "stroke=\"#ffffff\" stroke-width=\"7\"");
            line(&mut svg, door.between, "stroke=\"#0a7d33\" stroke-width=\"3\"");
            text(&mut svg, middle(door.between), -8.0, "#0a7d33", &door.name);
        }
        for sensor in &self.sensors {
            let ahead = sensor.direction(0.0);
            let tip = [sensor.place[0] + 0.5 * ahead[0], sensor.place[1] + 0.5 * ahead[1]];
            line(&mut svg, [sensor.place, tip], "stroke=\"#b00020\" stroke-width=\"2\"");
            let (x, y) = at(sensor.place);
            let _ = writeln!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"5\" fill=\"#b00020\"/>");
            text(&mut svg, tip, 14.0, "#b00020", &sensor.name);
        }
        svg.push_str("</svg>\n");
        svg
    }
}

/// Returns the mean of the corners.
fn center(polygon: &[Point]) -> Point {
    let n = polygon.len() as f64;
    let sum = polygon.iter().fold([0.0, 0.0], |sum, p| [sum[0] + p[0], sum[1] + p[1]]);
    [sum[0] / n, sum[1] / n]
}
