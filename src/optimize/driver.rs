//! prototype
use std::ops::ControlFlow;
use glam::DVec3;
use crate::{
    mesh::*, metric::{Change, Free, Objective}, render::RenderError,
};
use super::{quadratic::Quadratic, rng::Rng, simplex::{Simplex, Stop}, trial::{self, Search, Trial}};

#[derive(Clone, Debug)]
pub struct Params { pub seed: u64, pub max_evaluations: u64, pub delta: f64, pub solver: u32, pub bits: i32, pub swaps: bool, pub teleports: bool, pub speculative: bool }

pub struct Optimizer<'a> {
    pub mesh: &'a mut EditMesh,
    pub objective: &'a mut Objective,
    params: Params,
    rng: Rng,
    claimed: Vec<u64>,
    stamp: u64,
    pub step: Vec<f64>,
    pub start_evaluations: u64,
    pub log: Vec<String>,
}

impl<'a> Optimizer<'a> {
    pub fn new(mesh: &'a mut EditMesh, objective: &'a mut Objective, params: Params) -> Self {
        let n = mesh.n_vertex_slots();
        let start_evaluations = objective.evaluations();
        Self { rng: Rng::new(params.seed), claimed: Vec::new(), stamp: 0, step: vec![params.delta; n], mesh, objective, params, start_evaluations, log: vec![] }
    }
    fn claim(&mut self, faces: &[u32]) -> bool {
        self.claimed.resize(self.mesh.n_face_slots() + 2, 0);
        if faces.iter().any(|f| self.claimed[*f as usize] == self.stamp) { return false; }
        for f in faces { self.claimed[*f as usize] = self.stamp; }
        true
    }
    pub fn mean_edge(&self, v: VertexId) -> f64 {
        let mut n = Vec::new();
        self.mesh.neighbours(v, &mut n);
        n.iter().map(|w| self.mesh.position(v).distance(self.mesh.position(*w))).sum::<f64>() / n.len().max(1) as f64
    }
    fn frame(&self, v: VertexId) -> [DVec3; 3] {
        let n: DVec3 = self.mesh.faces_around(v).iter().map(|f| self.mesh.area_normal(*f)).sum();
        let n = n.normalize_or_zero();
        if n == DVec3::ZERO || self.params.solver == 0 { return [DVec3::X, DVec3::Y, DVec3::Z]; }
        let (a, b) = n.any_orthonormal_pair();
        [n, a, b]
    }
    fn free(&self, v: VertexId) -> Free { Free { vertex: v, at: self.mesh.position(v), normal: DVec3::ZERO } }
    fn search(&self, steps: Vec<f64>, value: Option<i64>) -> Search {
        match self.params.solver {
            0 | 1 => Search::Simplex(Simplex::new(vec![0.0; steps.len()], value, &steps, Stop { bits: self.params.bits, evaluations_per_dimension: 32, is_speculative: self.params.speculative })),
            _ => Search::Quadratic(Quadratic::new(steps, value, self.params.bits as u32)),
        }
    }
    fn noop(&self, vs: &[VertexId]) -> Option<Trial> {
        let free: Vec<Free> = vs.iter().map(|v| self.free(*v)).collect();
        let template = self.objective.template(self.mesh, Change::Nothing, &free)?;
        let steps: Vec<f64> = vs.iter().flat_map(|v| [self.mean_edge(*v) * self.step[v.index()]; 3]).collect();
        let frames = vs.iter().map(|v| self.frame(*v)).collect();
        Some(Trial { template, free, frames, has_normals: false, search: self.search(steps, Some(0)) })
    }
    fn commit(&mut self, t: &Trial) -> Result<i64, RenderError> {
        let (p, v) = t.best();
        if v >= 0 { return Ok(0); }
        let (places, normals) = t.unpack(&p);
        let mv = t.template.at(&places, &normals);
        let Some(d) = self.objective.commit_if_better(self.mesh, &mv)? else { return Ok(0) };
        for (f, to) in t.free.iter().zip(places) { self.mesh.displace(f.vertex, to); }
        Ok(d)
    }
    /// one sweep over all vertices
    pub fn sweep(&mut self, level: usize) -> Result<(i64, u64), RenderError> {
        let e0 = self.objective.evaluations();
        let mut all: Vec<VertexId> = (0..self.mesh.n_vertex_slots() as u32).map(VertexId).filter(|v| self.mesh.is_used(*v)).collect();
        for i in (1..all.len()).rev() { let j = self.rng.below(i + 1); all.swap(i, j); }
        let mut sum = 0;
        let floor = 0.01;
        all.retain(|v| self.step[v.index()] > floor);
        while !all.is_empty() {
            self.stamp += 1;
            let mut later = Vec::new();
            let mut trials = Vec::new();
            for v in all {
                let vs = if level == 1 { vec![v] } else { let mut n = Vec::new(); self.mesh.neighbours(v, &mut n); let w = n[self.rng.below(n.len())]; vec![v, w] };
                let Some(t) = self.noop(&vs) else { continue };
                if self.claim(t.template.touched()) { trials.push((vs, t)); } else { later.push(v); }
            }
            let (vs, mut ts): (Vec<_>, Vec<_>) = trials.into_iter().unzip();
            trial::run(self.objective, &mut ts)?;
            for (vs, t) in vs.iter().zip(&ts) {
                let d = self.commit(t)?;
                sum += d;
                let mut n = Vec::new();
                for v in vs {
                    let s = &mut self.step[v.index()];
                    if d < 0 { *s = (*s * 1.1).min(self.params.delta * 2.0);
                        self.mesh.neighbours(*v, &mut n);
                        for w in &n { let s = &mut self.step[w.index()]; *s = s.max(0.02); }
                    } else { *s *= 0.5; }
                }
            }
            all = later;
        }
        Ok((sum, self.objective.evaluations() - e0))
    }
    pub fn swaps(&mut self) -> Result<(i64, u64), RenderError> {
        let e0 = self.objective.evaluations();
        let edges = EdgeTable::new(self.mesh);
        let mut ts = Vec::new();
        let mut es = Vec::new();
        for e in edges.edges() {
            let [a, b] = edges.ends(e);
            let Some(plan) = self.mesh.plan_swap(a, b) else { continue };
            let Some(template) = self.objective.template(self.mesh, Change::Swap(&plan), &[]) else { continue };
            ts.push(Trial { template, free: vec![], frames: vec![], has_normals: false, search: Search::Start(None) });
            es.push(plan);
        }
        trial::run(self.objective, &mut ts)?;
        let mut order: Vec<usize> = (0..ts.len()).filter(|i| ts[*i].best().1 < 0).collect();
        order.sort_by_key(|i| (ts[*i].best().1, *i));
        self.stamp += 1;
        let mut sum = 0;
        for i in order {
            if !self.claim(ts[i].template.touched()) { continue; }
            let plan = es[i];
            if self.mesh.plan_swap(plan.ends[0], plan.ends[1]).is_none() { continue; }
            let Some(d) = self.objective.commit_if_better(self.mesh, ts[i].template.start())? else { continue };
            self.mesh.reswap(&plan);
            self.objective.follow(self.mesh);
            sum += d;
            for v in plan.ends.iter().chain(&plan.apexes) { let s = &mut self.step[v.index()]; *s = s.max(self.params.delta * 0.5); }
        }
        Ok((sum, self.objective.evaluations() - e0))
    }
    pub fn run(&mut self, on: &mut dyn FnMut(&str, i64, u64, &EditMesh, &Objective) -> ControlFlow<()>) -> Result<(), RenderError> {
        loop {
            let (d, e) = self.sweep(1)?;
            let mut flow = on("sweep", d, e, self.mesh, self.objective);
            if self.params.swaps && flow.is_continue() {
                let (d, e) = self.swaps()?;
                flow = on("swaps", d, e, self.mesh, self.objective);
            }
            if flow.is_break() { return Ok(()); }
        }
    }
}
