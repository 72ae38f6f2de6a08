//! The part of a specification that says how far each level goes.
//!
//! Every list names a budget of each level: as many values as there are levels or, where that makes
//! sense, one for all. 0 stands for a budget that a level does not have.

use super::{Fault, Kind, MAX_LEVELS, Method, Spec};

/// How far a level goes, of what [`Spec`] lists level by level. There are two kinds of budgets. A level goes on
/// until it is as small as it should be, by `triangles` and by `max_bytes`; but no further than it may, by
/// `max_d2` and by `screen_size`. One that is given by the second kind alone goes as far as it may.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LevelBudget {
    /// Triangles, at most.
    pub triangles: Option<u32>,
    /// Triangles were given as a share of the original's.
    pub is_ratio: bool,
    /// Bytes of the level's GLB file, at most.
    pub max_bytes: Option<u64>,
    /// d2 on the run-time views in percent of full scale, at most.
    pub max_d2: Option<f64>,
    /// Pixels that the bounding sphere is high where the level stands in for the original.
    pub screen_size: Option<f64>,
}

/// A list of budgets as validation sees it: its name, its values, whether one value is for all.
type List<'a> = (&'static str, Vec<f64>, bool);

/// Allowed values besides 0, in words too.
const RANGES: [(&str, f64, f64, &str); 4] = [
    ("ratios", f64::MIN_POSITIVE, 1.0 - f64::EPSILON / 2.0, "a share above 0 and below 1"),
    ("max_d2", 0.0, 100.0, "0 to 100 percent"),
    ("screen_size", 1.0, 65_536.0, "1 to 65536 pixels, or 0 for none"),
    ("max_bytes", 1024.0, 4_294_967_296.0, "1024 bytes to 4 GiB, or 0 for none"),
];

impl Spec {
    /// How many levels the job makes.
    pub fn n_levels(&self) -> usize {
        match self.kind() {
            Kind::Evaluate => 0,
            Kind::Optimize => 1,
            Kind::Simplify => {
                self.lists().iter().map(|(_, values, _)| values.len()).max().unwrap_or(0)
            }
        }
    }

    /// The same job with numbers of triangles beside shares of so many, which the original has.
    #[must_use]
    pub fn resolved(mut self, n_original: usize) -> Self {
        let count = |ratio: &f64| match *ratio {
            0.0 => 0,
            ratio => (ratio * n_original as f64).round().max(1.0) as u32,
        };
        self.triangles.extend(self.ratios.iter().map(count));
        self
    }

    /// How far each level goes; of a job whose shares are resolved.
    pub fn level_budgets(&self) -> Vec<LevelBudget> {
        let of = |i: usize| LevelBudget {
            triangles: at(&self.triangles, i).filter(|n| *n > 0),
            is_ratio: at(&self.ratios, i).is_some_and(|share| share > 0.0),
            max_bytes: at(&self.max_bytes, i).filter(|n| *n > 0),
            max_d2: at(&self.max_d2, i).filter(|d2| *d2 > 0.0),
            screen_size: at(&self.screen_size, i).filter(|pixels| *pixels > 0.0),
        };
        (0..self.n_levels()).map(of).collect()
    }

    fn lists(&self) -> [List<'_>; 5] {
        let counts = |of: &[u32]| of.iter().map(|n| f64::from(*n)).collect();
        [
            ("triangles", counts(&self.triangles), false),
            ("ratios", self.ratios.clone(), false),
            ("max_d2", self.max_d2.clone(), true),
            ("screen_size", self.screen_size.clone(), true),
            ("max_bytes", self.max_bytes.iter().map(|n| *n as f64).collect(), true),
        ]
    }

    pub(super) fn validate_levels(&self, faults: &mut Vec<Fault>) {
        let lists = self.lists();
        let n_levels = self.n_levels();
        let longest = lists.iter().find(|(_, values, _)| values.len() == n_levels && n_levels > 0);
        let field = longest.map_or("triangles", |(name, ..)| name);
        let mut fault = |field: &str, text: String| {
            faults.push(Fault { field: field.into(), text });
        };
        let is_twice = !self.ratios.is_empty() && !self.triangles.is_empty();
        if is_twice {
            let text = "numbers of triangles are given too: leave one of the two out";
            fault("ratios", text.into());
        }
        if n_levels == 0 || n_levels > MAX_LEVELS {
            fault(field, format!("{n_levels} levels of detail: ask for 1 to {MAX_LEVELS}"));
            // A million wrong levels are one fault.
            return;
        } else if self.method == Method::Cluster && n_levels > 1 {
            let text = format!("{n_levels} levels: vertex clustering makes one, so ask for one");
            fault(field, text);
        }
        for (name, values, is_for_all) in &lists {
            let n = values.len();
            let is_excused = if *is_for_all { n == 1 } else { is_twice };
            if n > 0 && n != n_levels && !is_excused {
                let text = format!("{n} values, and {n_levels} by {field}: give one a level");
                fault(name, text);
            }
        }
        validate_values(&lists, faults);
        self.validate_kinds(faults);
    }

    /// Whether there is a stage that knows of each budget.
    fn validate_kinds(&self, faults: &mut Vec<Fault>) {
        let has_pictures = self.method == Method::Image;
        let is_chain = self.method != Method::Cluster;
        let by_pictures =
            "only image-driven simplification looks at pictures: leave this out, or ask for that";
        let by_chain =
            "vertex clustering goes by triangles alone: leave this out, or simplify otherwise";
        let rules = [
            ("max_d2", !self.max_d2.is_empty() && !has_pictures, by_pictures),
            ("screen_size", !self.screen_size.is_empty() && !is_chain, by_chain),
            ("max_bytes", !self.max_bytes.is_empty() && !is_chain, by_chain),
        ];
        let broken = rules.into_iter().filter(|(_, is_broken, _)| *is_broken);
        faults.extend(
            broken.map(|(field, _, text)| Fault { field: field.into(), text: text.into() }),
        );
    }
}

/// Values in range, and something that every level goes by.
fn validate_values(lists: &[List<'_>], faults: &mut Vec<Fault>) {
    let has_other = |field: &str, i: usize| {
        let value = |(_, values, is_for_all): &List<'_>| {
            if *is_for_all { at(values, i) } else { values.get(i).copied() }
        };
        lists.iter().filter(|list| list.0 != field).filter_map(value).any(|x| x > 0.0)
    };
    for (name, values, _) in lists {
        let range = RANGES.iter().find(|row| row.0 == *name);
        for (i, value) in values.iter().enumerate() {
            let text = match range {
                _ if *value == 0.0 && has_other(name, i) => continue,
                None if *value == 0.0 => {
                    "0 triangles is not a level of detail: ask for at least 1".to_owned()
                }
                Some((.., words)) if *value == 0.0 => {
                    format!("0, and nothing else that this level goes by: use {words}")
                }
                Some((_, low, high, words)) if !(*low..=*high).contains(value) => {
                    format!("{value}: use {words}")
                }
                _ => continue,
            };
            let index =
                if values.len() > 1 || range.is_none() { format!("[{i}]") } else { String::new() };
            faults.push(Fault { field: format!("{name}{index}"), text });
        }
    }
}

/// The value of a level; one value is for all.
fn at<T: Copy>(values: &[T], level: usize) -> Option<T> {
    values.get(level).or(if values.len() == 1 { values.first() } else { None }).copied()
}
