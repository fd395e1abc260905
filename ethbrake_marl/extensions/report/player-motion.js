"use strict";
// Motion of N vehicles. An episode is a list of pieces (stretches of time with constant acceleration). A piece has 1 + 3 N
// numbers: the time at which it begins, the place of Vehicle 1, the gaps, the speeds and the accelerations. The functions
// of this file do not change the page.

const BODY_M = 4.5; // length of a drawn vehicle; in the physics, vehicles have no length
const FLASH_S = 0.3; // how long an impact is shown

function decodePieces(text, vehicles) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  const width = 1 + 3 * vehicles;
  const pieces = [];
  for (let at = 0; at < bytes.length; at += 8 * width) {
    const n = (k) => view.getFloat64(at + 8 * k, true);
    const some = (first, count) => Array.from({ length: count }, (_, k) => n(first + k));
    pieces.push({
      time: n(0),
      front: n(1),
      gaps: some(2, vehicles - 1),
      speeds: some(1 + vehicles, vehicles),
      accelerations: some(1 + 2 * vehicles, vehicles),
    });
  }
  return pieces;
}

// Index of the last entry whose time is at most `time`, found by bisection; -1 if all entries are later.
function lastBegun(list, time, timeOf) {
  let low = 0;
  let high = list.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (timeOf(list[middle]) <= time) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

function moveOn(piece, time) {
  const t = time - piece.time;
  const ways = piece.speeds.map((v, i) => (v + 0.5 * piece.accelerations[i] * t) * t);
  return {
    front: piece.front + ways[0],
    gaps: piece.gaps.map((gap, p) => Math.max(gap + ways[p] - ways[p + 1], 0)),
    speeds: piece.speeds.map((v, i) => v + piece.accelerations[i] * t),
    accelerations: piece.accelerations,
  };
}

// State of the line at a time; after the end of the episode, its state at the end.
function stateAt(episode, time) {
  const until = Math.min(time, episode.end);
  const k = Math.max(lastBegun(episode.pieces, until, (piece) => piece.time), 0);
  return moveOn(episode.pieces[k], until);
}

// Places of the front bumpers as drawn: bodies have a length, and the gaps between the bodies are the true gaps.
function frontsOf(state) {
  const fronts = [state.front];
  for (const gap of state.gaps) fronts.push(fronts[fronts.length - 1] - gap - BODY_M);
  return fronts;
}

// Gap ahead of each vehicle; for Vehicle 1 the gap to the obstacle, or null if there is no obstacle.
function gapsAhead(state, obstacle) {
  return [obstacle === null ? null : Math.max(obstacle - state.front, 0), ...state.gaps];
}

// Number of impacts and harm up to a time. An impact is the list [time, pair, closing speed, whether it is the first impact
// of its pair, number of impacts so far, first-impact harm so far, total harm so far].
function countedBy(episode, time) {
  const k = lastBegun(episode.impacts, time, (impact) => impact[0]);
  if (k < 0) return { impacts: 0, first: 0, total: 0 };
  const [, , , , impacts, first, total] = episode.impacts[k];
  return { impacts, first, total };
}

function struckAround(episode, time) {
  return episode.impacts.filter((impact) => impact[0] <= time && time < impact[0] + FLASH_S);
}

function steppedInAt(episode, time) {
  return episode.stepped.some((start) => start <= time && time < start + FLASH_S);
}

// Left and right end of the road that the vehicles of these episodes need, in m.
function roadOf(episodes) {
  let left = Infinity;
  let right = -Infinity;
  for (const episode of episodes) {
    for (const time of [...episode.pieces.map((piece) => piece.time), episode.end]) {
      const fronts = frontsOf(stateAt(episode, time));
      left = Math.min(left, fronts[fronts.length - 1] - BODY_M);
      right = Math.max(right, fronts[0]);
    }
    if (episode.obstacle !== null) right = Math.max(right, episode.obstacle + 1);
  }
  return { left: left - 3, right: right + 3 };
}

// Time at which all vehicles are at rest, or the end of the episode if a vehicle still moves.
function restOf(episode) {
  const last = episode.pieces[episode.pieces.length - 1];
  return last.speeds.every((v) => v === 0) ? last.time : episode.end;
}

// Curves as SVG paths. In each piece a gap is quadratic in time, a speed linear and an acceleration constant.
function curves(episode, until, x, y, vehicles) {
  const gaps = Array.from({ length: vehicles - 1 }, () => "");
  const speeds = Array.from({ length: vehicles }, () => "");
  const accelerations = Array.from({ length: vehicles }, () => "");
  const pair = (t, v, scale) => `${x(t).toFixed(2)} ${scale(v).toFixed(2)}`;
  episode.pieces.forEach((piece, k) => {
    const next = k + 1 < episode.pieces.length ? episode.pieces[k + 1].time : episode.end;
    const end = Math.min(next, until);
    const t = end - piece.time;
    if (t < 0 || (t === 0 && k > 0)) return;
    const after = moveOn(piece, end);
    const go = k === 0 ? "M" : "L";
    gaps.forEach((_, p) => {
      gaps[p] += `${go}${pair(piece.time, piece.gaps[p], y.gap)}`;
      const middle = piece.gaps[p] + ((piece.speeds[p] - piece.speeds[p + 1]) * t) / 2;
      gaps[p] += `Q${pair(piece.time + t / 2, middle, y.gap)} ${pair(end, after.gaps[p], y.gap)}`;
    });
    speeds.forEach((_, i) => {
      const v = piece.speeds[i];
      const a = piece.accelerations[i];
      speeds[i] += `${go}${pair(piece.time, v, y.speed)}L${pair(end, after.speeds[i], y.speed)}`;
      accelerations[i] += `${go}${pair(piece.time, a, y.acceleration)}L${pair(end, after.accelerations[i], y.acceleration)}`;
    });
  });
  return { gap: gaps, speed: speeds, acceleration: accelerations };
}
