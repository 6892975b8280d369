//! The map of a checkpoint: modules as tiles as wide as their bytes, in the colours of one property at a time; and the same
//! modules as a list, which has every figure.

use std::fmt::Write as _;

use super::super::format::{bytes, name, plural};
use super::super::inspect::{count, label};
use super::text;
use crate::check::inspect::{InspectedModule, MapProperty, ModuleMap, PropertyKind};
use crate::surgery::expr::TensorTransform;

/// Tiles narrower than this share of the map are drawn together.
const NARROWEST: u64 = 1_500;
/// Modules in the list. A model of 90 000 tensors that differ in every layer has more.
const LISTED: usize = 6_000;
/// Values without a colour of their own that have different ones.
const HUES: usize = 24;
/// What a merge did with a tensor that it took as it is.
const COPY: &str = TensorTransform::Copy.name();

/// Appends the map and the list. `id` is unique in the page.
pub(super) fn render(out: &mut String, id: &str, title: &str, map: &ModuleMap) {
    let total: u64 = map.modules.iter().map(|one| one.amount.bytes).fold(0, u64::saturating_add);
    if total == 0 {
        return;
    }
    let _ok = writeln!(out, "<h2>{}</h2>\n<div class=\"colours\">", text(title));
    choice(out, id, &map.properties);
    let colours: Vec<Vec<Colour>> = map.properties.iter().map(colours).collect();
    let painter = Painter { map, colours: &colours, total };
    let _ok = writeln!(
        out,
        "<button type=\"button\" data-back=\"{id}\" hidden>Whole model</button>\n<div class=\"map\" id=\"{id}\" role=\"img\" \
         aria-label=\"Map of the modules by bytes; the list below has the same figures\">"
    );
    let shares = map.modules.iter().fold(Vec::new(), |sum: Vec<u64>, one| added(sum, &one.shares));
    painter.tile(out, "all", total, &shares, "all modules", &|out| painter.tiles(out, &map.modules, "", 1));
    out.push_str("</div>\n");
    for (property, colours) in map.properties.iter().zip(&colours) {
        painter.legend(out, id, property, colours, &shares);
    }
    out.push_str("</div>\n<details class=\"tree\"><summary>Modules as a list</summary>\n");
    let mut room = LISTED;
    for one in &map.modules {
        listed(out, one, "", &mut room);
    }
    if room == 0 {
        out.push_str("<p class=\"dim\">Further modules are not listed; <code>inspect --depth 0</code> has all.</p>\n");
    }
    out.push_str("</details>\n");
}

fn added(mut sum: Vec<u64>, more: &[u64]) -> Vec<u64> {
    sum.resize(sum.len().max(more.len()), 0);
    for (own, more) in sum.iter_mut().zip(more) {
        *own = own.saturating_add(*more);
    }
    sum
}

const fn key(kind: PropertyKind) -> &'static str {
    match kind {
        PropertyKind::Dtype => "type",
        PropertyKind::File => "file",
        PropertyKind::Load => "load",
        PropertyKind::Change => "change",
        PropertyKind::Origin => "origin",
    }
}

const fn title(kind: PropertyKind) -> &'static str {
    match kind {
        PropertyKind::Dtype => "element type",
        PropertyKind::File => "file",
        PropertyKind::Load => "list of the load report",
        PropertyKind::Change => "change",
        PropertyKind::Origin => "origin",
    }
}

/// The choice of the property, and the rules that follow it; the first is chosen.
fn choice(out: &mut String, id: &str, properties: &[MapProperty]) {
    out.push_str("<fieldset><legend>Colour by</legend>");
    for (at, property) in properties.iter().enumerate() {
        let key = key(property.kind);
        let checked = if at == 0 { " checked" } else { "" };
        let title = title(property.kind);
        let _ok =
            write!(out, "<label><input type=\"radio\" name=\"{id}-by\" id=\"{id}-{key}\"{checked}> {title}</label>");
    }
    out.push_str("</fieldset>\n<style>");
    for property in properties {
        let key = key(property.kind);
        let _ok = write!(
            out,
            ".colours:has(#{id}-{key}:checked) #{id} .tile > span {{ background: var(--{key}) }}\n\
             .colours:has(#{id}-{key}:checked) .legend.{key} {{ display: flex }}\n"
        );
    }
    out.push_str("</style>\n");
}

/// The colour of a value; black text can be read on it.
struct Colour {
    plain: String,
    /// Whether a tile that has no other value is hatched: what a merge did not copy.
    hatched: bool,
}

impl Colour {
    fn alone(&self) -> String {
        let Self { plain, hatched } = self;
        match hatched {
            true => format!("repeating-linear-gradient(45deg,{plain} 0 6px,#fff 6px 9px)"),
            false => plain.clone(),
        }
    }
}

/// A colour for each value of a property.
fn colours(property: &MapProperty) -> Vec<Colour> {
    let mut roles: Vec<&str> = Vec::new();
    let mut colours = Vec::new();
    for (at, value) in property.values.iter().enumerate() {
        colours.push(match (known(value), property.kind) {
            // What no list names.
            (None, PropertyKind::Load) => Colour { plain: "#cfe8cf".to_owned(), hatched: false },
            (Some(colour), _) => Colour { plain: colour.to_owned(), hatched: false },
            (None, PropertyKind::Origin) => of_origin(value, &mut roles),
            (None, _) => Colour { plain: format!("hsl({} 65% 78%)", hue(at)), hatched: false },
        });
    }
    colours
}

fn hue(at: usize) -> usize {
    at.checked_rem(HUES).unwrap_or_default().saturating_mul(137) % 360
}

/// A hue for each donor, and a darker one for what is not a copy; `roles` are the donors so far.
fn of_origin<'v>(value: &'v str, roles: &mut Vec<&'v str>) -> Colour {
    let (role, how) = value.split_once(": ").unwrap_or(("", value));
    let place = roles.iter().position(|known| *known == role).unwrap_or_else(|| {
        roles.push(role);
        roles.len().saturating_sub(1)
    });
    let hatched = how != COPY;
    let light = if hatched { 66 } else { 80 };
    Colour { plain: format!("hsl({} 60% {light}%)", hue(place.saturating_add(1))), hatched }
}

/// The colour of a value that has the same one in every map.
fn known(value: &str) -> Option<&'static str> {
    Some(match value {
        "BF16" => "#8ecae6",
        "F16" => "#a8dadc",
        "F32" => "#ffd166",
        "F64" => "#f4a261",
        "I8" | "U8" => "#cdb4db",
        "I32" | "U32" | "I64" | "U64" | "I16" | "U16" => "#d8c3a5",
        "equal" | "no difference found" | "equal or not compared" | "in both" => "#cfe8cf",
        "unexpected" | "removed" | "BOOL" | "left out" | "unknown" => "#c9c9c9",
        "mismatched" | "reshaped" => "#ff8a80",
        "silent" | "changed" => "#ffb74d",
        "added" => "#80cbc4",
        "recast" => "#b39ddb",
        _ => return None,
    })
}

struct Painter<'m> {
    map: &'m ModuleMap,
    /// Colours of the values of each property.
    colours: &'m [Vec<Colour>],
    total: u64,
}

impl Painter<'_> {
    /// The tiles of modules beside each other; those too narrow to be seen as one.
    fn tiles(&self, out: &mut String, modules: &[InspectedModule], outer: &str, level: usize) {
        let is_wide = |one: &&InspectedModule| one.amount.bytes.saturating_mul(NARROWEST) >= self.total;
        let (wide, narrow): (Vec<_>, Vec<_>) = modules.iter().partition(is_wide);
        for one in wide {
            let below = label(one, outer);
            let inner = |out: &mut String| self.tiles(out, &one.modules, &one.name, level.saturating_add(1));
            let described = format!("{}: {}", label(one, ""), amount(one));
            self.tile(out, &below, one.amount.bytes, &one.shares, &described, &inner);
        }
        let rest = narrow.iter().fold(0_u64, |sum, one| sum.saturating_add(one.amount.bytes));
        if rest > 0 {
            let shares = narrow.iter().fold(Vec::new(), |sum, one| added(sum, &one.shares));
            let described = format!("{} more: {}", plural(narrow.len(), "module"), bytes(rest));
            self.tile(out, "…", rest, &shares, &described, &|_| ());
        }
    }

    /// A tile as wide as its bytes, above those that `inner` appends.
    fn tile(
        &self,
        out: &mut String,
        label: &str,
        size: u64,
        shares: &[u64],
        described: &str,
        inner: &dyn Fn(&mut String),
    ) {
        let _ok = write!(out, "<div class=\"tile\" style=\"flex-grow:{size}{}\"", self.paint(shares));
        let _ok = write!(out, " title=\"{}\"><span>{}</span>", text(described), text(label));
        let mut inside = String::new();
        inner(&mut inside);
        if !inside.is_empty() {
            let _ok = write!(out, "<div>{inside}</div>");
        }
        out.push_str("</div>\n");
    }

    /// A colour for each property: one, or stripes by the shares of the values.
    fn paint(&self, shares: &[u64]) -> String {
        let mut out = String::new();
        let mut rest = shares;
        for (property, colours) in self.map.properties.iter().zip(self.colours) {
            let (own, others) = rest.split_at_checked(property.values.len()).unwrap_or_default();
            rest = others;
            let all: u64 = own.iter().copied().fold(0, u64::saturating_add);
            let present: Vec<(&u64, &Colour)> = own.iter().zip(colours).filter(|(bytes, _)| **bytes > 0).collect();
            let _ok = match present.as_slice() {
                [] => Ok(()),
                [(_, colour)] => write!(out, ";--{}:{}", key(property.kind), colour.alone()),
                several => {
                    let mut stops = Vec::new();
                    let mut at = 0_u64;
                    for (bytes, colour) in several {
                        let (from, to) = (percent(at, all), percent(at.saturating_add(**bytes), all));
                        stops.push(format!("{} {from}% {to}%", colour.plain));
                        at = at.saturating_add(**bytes);
                    }
                    write!(out, ";--{}:linear-gradient(90deg,{})", key(property.kind), stops.join(","))
                }
            };
        }
        out
    }

    /// The colours of a property with their shares of all bytes.
    fn legend(&self, out: &mut String, id: &str, property: &MapProperty, colours: &[Colour], shares: &[u64]) {
        let before = self.map.properties.iter().take_while(|one| one.kind != property.kind);
        let start: usize = before.map(|one| one.values.len()).fold(0, usize::saturating_add);
        let _ok = writeln!(out, "<ul class=\"legend {}\" aria-label=\"Colours of {id}\">", key(property.kind));
        for (at, (value, colour)) in property.values.iter().zip(colours).enumerate() {
            let share = shares.get(start.saturating_add(at)).copied().unwrap_or_default();
            if share == 0 {
                continue;
            }
            let _ok = writeln!(
                out,
                "<li><span class=\"swatch\" style=\"background:{}\"></span>{} <span class=\"dim\">{}, {} %</span></li>",
                colour.alone(),
                text(&name(value)),
                bytes(share),
                percent(share, self.total)
            );
        }
        out.push_str("</ul>\n");
    }
}

/// A share in per cent, with one decimal.
pub(super) fn percent(part: u64, all: u64) -> String {
    let tenths = u128::from(part).saturating_mul(1000).checked_div(u128::from(all)).unwrap_or_default();
    let (whole, tenth) = (tenths.checked_div(10).unwrap_or_default(), tenths % 10);
    if tenth == 0 { whole.to_string() } else { format!("{whole}.{tenth}") }
}

fn amount(module: &InspectedModule) -> String {
    let all = module.amount;
    format!("{}, {} parameters, {}", plural(all.tensors, "tensor"), count(all.parameters), bytes(all.bytes))
}

/// A module in the list, with those inside; `room` is how many may follow.
fn listed(out: &mut String, module: &InspectedModule, outer: &str, room: &mut usize) {
    let Some(left) = room.checked_sub(1) else { return };
    *room = left;
    let (label, amount) = (text(&label(module, outer)), amount(module));
    let line = format!("<code>{label}</code><span class=\"amount\">{amount}</span>");
    if module.modules.is_empty() {
        let _ok = writeln!(out, "<div class=\"leaf\">{line}</div>");
        return;
    }
    let _ok = writeln!(out, "<details><summary>{line}</summary>");
    for one in &module.modules {
        listed(out, one, &module.name, room);
    }
    out.push_str("</details>\n");
}
