//! `scanhub site`: checks a site file, and draws its plan.

use std::fmt::Write as _;
use std::io::Write;
use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use scanhub_files::{output, regular_file};
use scanhub_schema::{Failure, Kind, Printable};
use scanhub_verbs::context::Context;
use scanhub_verbs::output::{ExitReason, Output, verb_result};
use serde::Serialize;

use crate::track::Site;
use crate::track::geometry::{Point, middle};

/// Check and draw the plan of a site: sensors, rooms and doors
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  scanhub site check house.toml")]
pub struct SiteArgs {
    #[command(subcommand)]
    command: SiteCommand,
}

#[derive(Clone, Debug, Subcommand)]
enum SiteCommand {
    /// Check a site file. If it has an error, show the position of the error, and exit with code 78
    #[command(after_help = "Example:\n  scanhub site check house.toml --svg house.svg")]
    Check {
        /// Site file with sensors, rooms and doors
        file: PathBuf,
        /// Draw the plan into this file
        #[arg(long, value_name = "OUT")]
        svg: Option<PathBuf>,
        /// Replace an existing file of --svg
        #[arg(long, requires = "svg")]
        force: bool,
    },
}

/// JSON line with the contents of a site file.
#[derive(Serialize)]
struct Plan<'a> {
    class: &'static str,
    sensors: Vec<&'a str>,
    rooms: Vec<&'a str>,
    /// Rooms without a sensor.
    unwatched: Vec<&'a str>,
    doors: Vec<&'a str>,
    gaps: usize,
    ignored: Vec<&'a str>,
}

impl SiteArgs {
    /// Checks a site file, and prints its contents.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Site::read`], and [`Kind::Failed`] if a file or the output cannot be written.
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let SiteCommand::Check { file, svg, force } = &self.command;
        let site = Site::read(file)?;
        if let Some(svg) = svg {
            output::write(svg, site.svg().as_bytes(), *force)?;
        }
        let watched = site.rooms_with_sensor();
        let unwatched = site.rooms.iter().zip(&watched).filter(|(_, is_watched)| !**is_watched);
        let plan = Plan {
            class: "site",
            sensors: site.sensors.iter().map(|sensor| sensor.name.as_str()).collect(),
            rooms: site.rooms.iter().map(|room| room.name.as_str()).collect(),
            unwatched: unwatched.map(|(room, _)| room.name.as_str()).collect(),
            doors: site.doors.iter().map(|door| door.name.as_str()).collect(),
            gaps: site.gaps.len(),
            ignored: site.ignored.iter().map(|area| area.name.as_str()).collect(),
        };
        let mut out = Output::new(&mut context.out);
        verb_result(if context.json { out.json(&plan) } else { plan.write(&mut out) })
    }
}

impl Plan<'_> {
    fn write(&self, out: &mut Output<'_>) -> Result<(), ExitReason> {
        let doors = if self.doors.is_empty() { "none".to_owned() } else { self.doors.join(", ") };
        out.line(|line| write!(line, "sensors: {}", self.sensors.join(", ")))?;
        out.line(|line| write!(line, "rooms: {}", self.rooms.join(", ")))?;
        out.line(|line| write!(line, "doors: {doors}"))?;
        out.line(|line| write!(line, "gaps: {}", self.gaps))?;
        if !self.ignored.is_empty() {
            out.line(|line| write!(line, "ignored areas: {}", self.ignored.join(", ")))?;
        }
        if !self.unwatched.is_empty() {
            out.line(|line| write!(line, "no sensor is in: {}", self.unwatched.join(", ")))?;
        }
        Ok(())
    }
}

/// Pixels per meter.
const PIXELS_PER_M: f64 = 60.0;
/// Margin around the plan, in meters.
const MARGIN_M: f64 = 0.8;

impl Site {
    /// Reads the site file at `path`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Input`] if the file cannot be read, and the errors of [`Site::parse`].
    pub fn read(path: &Path) -> Result<Site, Failure> {
        let text = regular_file::read_text(path, regular_file::MAX_FILE_BYTES).map_err(|error| {
            let message = format!("{}: {error}", path.display());
            Failure::new(Kind::Input, message, "name a readable site file; docs/tracks.md has one")
        })?;
        Site::parse(&path.display().to_string(), &text)
    }

    /// Returns a drawing of the site: rooms with their names, ignored areas, doors, gaps, and sensors with their
    /// directions. One meter is 60 pixels, and y points up.
    pub fn svg(&self) -> String {
        let corners = self.rooms.iter().flat_map(|room| room.polygon.iter().copied());
        let corners = corners.chain(self.ignored.iter().flat_map(|area| area.polygon.iter().copied()));
        let points: Vec<Point> = corners.chain(self.sensors.iter().map(|sensor| sensor.position)).collect();
        let minimum = |axis: usize| points.iter().map(|p| p[axis]).fold(f64::INFINITY, f64::min) - MARGIN_M;
        let most = |axis: usize| points.iter().map(|p| p[axis]).fold(f64::NEG_INFINITY, f64::max) + MARGIN_M;
        let (left, top) = (minimum(0), most(1));
        let (width, height) = (PIXELS_PER_M * (most(0) - left), PIXELS_PER_M * (top - minimum(1)));
        let at = |point: Point| (PIXELS_PER_M * (point[0] - left), PIXELS_PER_M * (top - point[1]));
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width:.0} {height:.0}\" \
             font-family=\"sans-serif\" font-size=\"13\">\n\
             <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n"
        );
        let text = |svg: &mut String, point: Point, down: f64, color: &str, words: &str| {
            let (x, y) = at(point);
            // XML does not allow control characters, even if they are escaped.
            let words = Printable(words).to_string().replace(['\n', '\u{FFFE}', '\u{FFFF}'], "?");
            let words = words.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
            let _ = writeln!(
                svg,
                "<text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\" fill=\"{color}\">{words}</text>",
                y + down
            );
        };
        let polygon = |svg: &mut String, corners: &[Point], style: &str| {
            let corners: Vec<String> =
                corners.iter().map(|&p| at(p)).map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
            let _ = writeln!(svg, "<polygon points=\"{}\" {style}/>", corners.join(" "));
        };
        for (room, watched) in self.rooms.iter().zip(self.rooms_with_sensor()) {
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
            let tip = [sensor.position[0] + 0.5 * ahead[0], sensor.position[1] + 0.5 * ahead[1]];
            line(&mut svg, [sensor.position, tip], "stroke=\"#b00020\" stroke-width=\"2\"");
            let (x, y) = at(sensor.position);
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
