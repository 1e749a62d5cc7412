//! A chart as SVG: lines with their spread over an axis, or stacked bars in groups. Readable on light and on dark pages,
//! because it has no background and no extreme colour. Refuses to know what is drawn, and to hide zero: a linear y axis
//! begins there.
#![allow(dead_code)] // A bench draws lines or bars.

use std::fmt::Write;
use std::io;
use std::path::Path;

/// How an axis is divided. A logarithmic one has no place for zero and less: they stand at its lower end.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Scale {
    Linear,
    Log,
}

/// A value with its spread, in the units of the axes. Among bars `x` is the number of the group, from 0.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Point {
    pub(crate) x: f64,
    pub(crate) y: f64,
    pub(crate) least: f64,
    pub(crate) most: f64,
}

impl Point {
    /// A value without spread.
    pub(crate) fn exact(x: f64, y: f64) -> Point {
        Point { x, y, least: y, most: y }
    }
}

/// What has one colour and one line in the legend. Points stand in the order in which a line joins them.
#[derive(Clone, Debug)]
pub(crate) struct Series {
    pub(crate) name: String,
    pub(crate) points: Vec<Point>,
}

/// A chart that is described until it is written.
pub(crate) struct Chart {
    title: String,
    labels: [String; 2],
    scales: [Scale; 2],
    /// Names of the groups of bars; without any the series are lines.
    groups: Vec<String>,
    series: Vec<Series>,
}

impl Chart {
    /// An empty one; labels name the quantity and its unit.
    pub(crate) fn new(title: &str, x_label: &str, y_label: &str) -> Chart {
        Chart {
            title: title.to_owned(),
            labels: [x_label.to_owned(), y_label.to_owned()],
            scales: [Scale::Linear; 2],
            groups: Vec::new(),
            series: Vec::new(),
        }
    }

    /// How the x axis of lines is divided.
    pub(crate) fn x(mut self, scale: Scale) -> Chart {
        self.scales[0] = scale;
        self
    }

    /// How the y axis of lines is divided; bars stand on zero, so theirs stays linear.
    pub(crate) fn y(mut self, scale: Scale) -> Chart {
        self.scales[1] = scale;
        self
    }

    /// A line for each of `series`.
    pub(crate) fn lines(mut self, series: &[Series]) -> Chart {
        self.series.extend_from_slice(series);
        self
    }

    /// A bar for each of `groups`, whose names may have more than one line, with the values of `series` one upon the
    /// other, the first at the bottom.
    pub(crate) fn bars(mut self, groups: &[&str], series: &[Series]) -> Chart {
        self.scales = [Scale::Linear; 2];
        self.groups = groups.iter().map(|group| group.to_string()).collect();
        self.series.extend_from_slice(series);
        self
    }

    /// Writes it to `path`, whose directory is made where it is not there.
    pub(crate) fn write(&self, path: &Path) -> io::Result<()> {
        if let Some(directory) = path.parent() {
            std::fs::create_dir_all(directory)?;
        }
        std::fs::write(path, self.svg())
    }

    /// The whole text.
    pub(crate) fn svg(&self) -> String {
        let lines_of = |group: &String| group.lines().count();
        let label_lines = self.groups.iter().map(lines_of).max().unwrap_or(1);
        let x_label_at = BOTTOM + 22.0 + LINE * label_lines as f64;
        let legend_at = x_label_at + 10.0;
        let height = legend_at + LINE * self.series.len() as f64 + 12.0;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" font-family=\"sans-serif\" \
             font-size=\"13\">\n<title>{0}</title>\n<style>text{{fill:#808080}}.axis{{stroke:#808080;fill:none}}\
             .grid{{stroke:#808080;stroke-opacity:.3}}</style>\n<text x=\"{LEFT}\" y=\"22\" font-size=\"15\">{0}</text>\n",
            escaped(&self.title)
        );
        let y_axis = Axis::new(self.scales[1], true, self.heights(), [BOTTOM, TOP]);
        for &tick in &y_axis.ticks {
            let y = y_axis.at(tick);
            let _ = write!(svg, "<path class=\"grid\" d=\"M{LEFT} {y:.1}H{RIGHT}\"/>");
            text(&mut svg, LEFT - 8.0, y + 4.5, "end", &number(tick));
        }
        let _ = writeln!(svg, "<path class=\"axis\" d=\"M{LEFT} {TOP}V{BOTTOM}H{RIGHT}\"/>");
        if self.groups.is_empty() {
            self.draw_lines(&mut svg, &y_axis);
        } else {
            self.draw_bars(&mut svg, &y_axis);
        }
        text(&mut svg, (LEFT + RIGHT) / 2.0, x_label_at, "middle", &self.labels[0]);
        let middle = (TOP + BOTTOM) / 2.0;
        let _ = writeln!(
            svg,
            "<text x=\"16\" y=\"{middle}\" text-anchor=\"middle\" transform=\"rotate(-90 16 {middle})\">{}</text>",
            escaped(&self.labels[1])
        );
        for (number, series) in self.series.iter().enumerate() {
            let (y, colour) = (legend_at + LINE * number as f64, colour(number));
            let _ = write!(
                svg,
                "<rect x=\"{LEFT}\" y=\"{}\" width=\"18\" height=\"9\" fill=\"{colour}\"/>",
                y + 3.0
            );
            text(&mut svg, LEFT + 26.0, y + 12.0, "start", &series.name);
        }
        svg.push_str("</svg>\n");
        svg
    }

    /// All values that the y axis must hold.
    fn heights(&self) -> Vec<f64> {
        if self.groups.is_empty() {
            return self.points().flat_map(|point| [point.y, point.least, point.most]).collect();
        }
        let mut tops = vec![0.0; self.groups.len()];
        let mut heights = Vec::new();
        for point in self.points() {
            if let Some(top) = tops.get_mut(point.x as usize) {
                heights.extend([*top + point.y, *top + point.most]);
                *top += point.y;
            }
        }
        heights
    }

    fn points(&self) -> impl Iterator<Item = &Point> {
        self.series.iter().flat_map(|series| &series.points)
    }

    fn draw_lines(&self, svg: &mut String, y_axis: &Axis) {
        let values = self.points().map(|point| point.x).collect();
        let x_axis = Axis::new(self.scales[0], false, values, [LEFT, RIGHT]);
        for &tick in &x_axis.ticks {
            let x = x_axis.at(tick);
            let _ = write!(svg, "<path class=\"axis\" d=\"M{x:.1} {BOTTOM}v5\"/>");
            text(svg, x, BOTTOM + 19.0, "middle", &number(tick));
        }
        for (number, series) in self.series.iter().enumerate() {
            let colour = colour(number);
            let mut line = String::new();
            for (i, point) in series.points.iter().enumerate() {
                let pen = if i == 0 { 'M' } else { 'L' };
                let _ = write!(line, "{pen}{:.1} {:.1}", x_axis.at(point.x), y_axis.at(point.y));
            }
            let _ =
                writeln!(svg, "<path d=\"{line}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\"/>");
            for point in &series.points {
                let x = x_axis.at(point.x);
                spread(svg, x, y_axis, point.least, point.most, colour);
                let (y, named) = (y_axis.at(point.y), escaped(&series.name));
                let _ = writeln!(
                    svg,
                    "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3.5\" fill=\"{colour}\"><title>{named}: {}, {}</title></circle>",
                    self::number(point.x),
                    self::number(point.y)
                );
            }
        }
    }

    fn draw_bars(&self, svg: &mut String, y_axis: &Axis) {
        let step = (RIGHT - LEFT) / self.groups.len() as f64;
        let middle = |group: usize| LEFT + step * (group as f64 + 0.5);
        for (group, name) in self.groups.iter().enumerate() {
            for (line, part) in name.lines().enumerate() {
                text(svg, middle(group), BOTTOM + 19.0 + LINE * line as f64, "middle", part);
            }
        }
        let (width, mut tops) = ((step * 0.7).min(60.0), vec![0.0; self.groups.len()]);
        for (number, series) in self.series.iter().enumerate() {
            for point in &series.points {
                let group = point.x as usize;
                let Some(top) = tops.get_mut(group) else { continue };
                let (low, high) = (y_axis.at(*top), y_axis.at(*top + point.y));
                let _ = writeln!(
                    svg,
                    "<rect x=\"{:.1}\" y=\"{high:.1}\" width=\"{width:.1}\" height=\"{:.1}\" fill=\"{}\"><title>{}: {}</title></rect>",
                    middle(group) - width / 2.0,
                    low - high,
                    colour(number),
                    escaped(&series.name),
                    self::number(point.y)
                );
                spread(svg, middle(group), y_axis, *top + point.least, *top + point.most, "#808080");
                *top += point.y;
            }
        }
    }
}

/// An axis with room for its values, between two ticks.
struct Axis {
    scale: Scale,
    ticks: Vec<f64>,
    ends: [f64; 2],
    pixels: [f64; 2],
}

impl Axis {
    fn new(scale: Scale, from_zero: bool, mut values: Vec<f64>, pixels: [f64; 2]) -> Axis {
        values.retain(|value| value.is_finite() && (scale == Scale::Linear || *value > 0.0));
        let least = values.iter().copied().reduce(f64::min).unwrap_or(1.0);
        let most = values.iter().copied().reduce(f64::max).unwrap_or(1.0);
        let ticks = match scale {
            Scale::Linear if from_zero => even(least.min(0.0), most.max(0.0)),
            Scale::Linear => even(least, most),
            Scale::Log => decades(least, most),
        };
        Axis { scale, ends: [ticks[0], ticks[ticks.len() - 1]], ticks, pixels }
    }

    /// The pixel of `value`.
    fn at(&self, value: f64) -> f64 {
        let linear = |value: f64| if self.scale == Scale::Log { value.log10() } else { value };
        let [from, to] = self.ends.map(linear);
        let part = (linear(value.max(self.ends[0])) - from) / (to - from);
        self.pixels[0] + part * (self.pixels[1] - self.pixels[0])
    }
}

/// Ticks at multiples of 1, 2 or 5 times a power of ten, the first and the last around the values.
fn even(least: f64, most: f64) -> Vec<f64> {
    let span = if most > least { most - least } else { most.abs().max(1.0) };
    let power = 10_f64.powf((span / 6.0).log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|n| n * power).into_iter().find(|step| span / step <= 6.0);
    let step = step.unwrap_or(10.0 * power);
    let first = (least / step).floor();
    let last = (most / step).ceil().max(first + 1.0);
    (0..=(last - first) as usize).map(|i| (first + i as f64) * step).collect()
}

/// Ticks at powers of ten around the values, and at 2 and 5 times these where they are few.
fn decades(least: f64, most: f64) -> Vec<f64> {
    let (first, last) = (least.log10().floor() as i32, most.log10().floor() as i32);
    let parts: &[f64] = if last - first < 3 { &[1.0, 2.0, 5.0] } else { &[1.0] };
    let all: Vec<f64> =
        (first..=last + 1).flat_map(|n| parts.iter().map(move |part| part * 10_f64.powi(n))).collect();
    let begin = all.iter().rposition(|&tick| tick <= least).unwrap_or(0);
    let end = all.iter().position(|&tick| tick >= most).unwrap_or(all.len() - 1).max(begin + 1);
    all[begin..=end].to_vec()
}

/// A tick's number without the digits that only binary fractions have.
fn number(tick: f64) -> String {
    let text = format!("{tick:.9}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    let (whole, rest) = text.split_at(text.find('.').unwrap_or(text.len()));
    let mut grouped = String::new();
    for (i, digit) in whole.chars().enumerate() {
        let behind = whole.len() - i;
        if whole.len() > 4 && i > 0 && behind % 3 == 0 && !grouped.ends_with('-') {
            grouped.push(',');
        }
        grouped.push(digit);
    }
    grouped + rest
}

/// A thin bar from `least` to `most`, where these differ.
fn spread(svg: &mut String, x: f64, axis: &Axis, least: f64, most: f64, colour: &str) {
    if most > least {
        let (low, high) = (axis.at(least), axis.at(most));
        let _ = writeln!(
            svg,
            "<path d=\"M{x:.1} {low:.1}V{high:.1}m-4 0h8M{:.1} {low:.1}h8\" fill=\"none\" stroke=\"{colour}\"/>",
            x - 4.0
        );
    }
}

fn text(svg: &mut String, x: f64, y: f64, anchor: &str, text: &str) {
    let text = escaped(text);
    let _ = writeln!(svg, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{text}</text>");
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

fn colour(number: usize) -> &'static str {
    COLOURS[number % COLOURS.len()]
}

/// Of middling lightness, and told apart by most eyes.
const COLOURS: [&str; 6] = ["#3b8fd4", "#d9822b", "#2f9e77", "#cc5a8b", "#8f7ad6", "#9a8a2c"];
/// The page and the field of the values on it, in pixels.
const WIDTH: f64 = 720.0;
const LEFT: f64 = 86.0;
const RIGHT: f64 = 700.0;
const TOP: f64 = 40.0;
const BOTTOM: f64 = 340.0;
/// A line of text.
const LINE: f64 = 18.0;
