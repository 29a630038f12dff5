// Poses and draws one avatar on the CPU, in a worker: no GPU, no library.
//
// The model is that of grmm/player/distillation.py: a linear mesh at rest, skinned by five joints;
// Gaussians on its faces, moved by a few blend shapes; colours quadratic in the view direction. The
// picture is blended front to back as express50/native/blend.h does, with a table for 2^-x.
"use strict";

const PARENTS = [-1, 0, 1, 1, 1];
const OPAQUE = 4 / 255;  // a pixel that lets less light through is finished
const SHIFT = 3, TILE = 1 << SHIFT, STEPS = 64, LOG2E = Math.LOG2E;
const POWERS = Float32Array.from({length: 9 * STEPS}, (_, i) => 2 ** (-(i + 0.5) / STEPS));

// Arrays of the file: whole numbers times one scale for each row and channel.
function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const kinds = {int8: Int8Array, int16: Int16Array, uint16: Uint16Array, uint32: Uint32Array,
                 float32: Float32Array};
  const arrays = {};
  for (const [name, {kind, shape, offset, scales}] of Object.entries(header.arrays)) {
    const size = shape.reduce((a, b) => a * b, 1);
    const raw = new kinds[kind](buffer, 4 + length + offset, size);
    const channels = shape[shape.length - 1], points = shape[shape.length - 2];
    arrays[name] = raw;
    if (name === "shapes") arrays.shapeScales = Float32Array.from(scales);
    else if (scales) arrays[name] = Float32Array.from(raw, (value, i) =>
      value * scales[Math.floor(i / (points * channels)) * channels + i % channels]);
  }
  return {header, ...arrays};
}

function rotation(x, y, z) {  // of an axis-angle vector, row-major
  const angle = Math.hypot(x, y, z) || 1e-12, s = Math.sin(angle), c = 1 - Math.cos(angle);
  x /= angle; y /= angle; z /= angle;
  return [1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y,
          c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x,
          c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)];
}

function multiplied(a, b) {  // 3 x 3, row-major
  return [0, 1, 2, 3, 4, 5, 6, 7, 8].map(i => {
    const row = i - i % 3, column = i % 3;
    return a[row] * b[column] + a[row + 1] * b[column + 3] + a[row + 2] * b[column + 6];
  });
}

function applied(m, x, y, z) {
  return [m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z,
          m[6] * x + m[7] * y + m[8] * z];
}

class Drawer {
  constructor(buffer) {
    Object.assign(this, unpack(buffer));
    this.V = this.rest.length / 3;
    this.N = this.opacities.length;
    this.K = this.header.codes;
    this.X = this.header.coefficients.length;
    this.vertices = new Float32Array(3 * this.V);
    this.splats = new Float32Array(10 * this.N);  // x y l11 l21 l22 opacity cutoff r g b
    this.boxes = new Int32Array(4 * this.N);
    this.depths = new Float32Array(this.N);
    this.keys = new Uint16Array(this.N);
    this.visible = new Uint32Array(this.N);
    this.order = new Uint32Array(this.N);
    this.counts = new Uint32Array(65537);
    this.blend = new Float32Array(1 + this.K);
  }

  // Camera axes are OpenCV's. camera: {rotation (9), shift (3), focal, size}.
  draw(parameters, codes, camera, target) {
    this.pose(parameters, codes, camera);
    const count = this.project(camera);
    this.sort(count);
    return this.rasterize(count, camera.size, target);
  }

  pose(parameters, codes, camera) {
    const {X, V, rest, shapes, shapeScales, skinning, joints, vertices} = this;
    const turns = [rotation(0, 0, 0)];
    const features = Array.from(parameters.subarray(0, X));
    for (let j = 0; j < 4; ++j) {
      const at = X + 3 * j;
      const turn = rotation(parameters[at], parameters[at + 1], parameters[at + 2]);
      turns.push(turn);
      turn.forEach((value, i) => features.push(value - (i % 4 === 0 ? 1 : 0)));
    }
    features.push(...codes);
    vertices.set(rest);
    features.forEach((weight, f) => {
      if (Math.abs(weight) < 1e-5) return;
      const sx = weight * shapeScales[3 * f], sy = weight * shapeScales[3 * f + 1],
            sz = weight * shapeScales[3 * f + 2];
      if (!(sx || sy || sz)) return;
      for (let i = 0, at = 3 * f * V; i < 3 * V; i += 3, at += 3) {
        vertices[i] += sx * shapes[at];
        vertices[i + 1] += sy * shapes[at + 1];
        vertices[i + 2] += sz * shapes[at + 2];
      }
    });
    // Rest to camera by joint: turn and shift, three rows of four numbers each.
    const bones = new Float32Array(60), worldTurns = [], worldJoints = [];
    const joint = (j, c) => {
      let value = joints[3 * j + c];
      for (let x = 0; x < X; ++x) value += parameters[x] * joints[15 * (x + 1) + 3 * j + c];
      return value;
    };
    const at = PARENTS.map((_, j) => [joint(j, 0), joint(j, 1), joint(j, 2)]);
    PARENTS.forEach((parent, j) => {
      const bone = parent < 0 ? at[j] : at[j].map((value, c) => value - at[parent][c]);
      const moved = parent < 0 ? bone : applied(worldTurns[parent], ...bone);
      worldJoints.push(parent < 0 ? moved : moved.map((v, c) => v + worldJoints[parent][c]));
      worldTurns.push(parent < 0 ? turns[j] : multiplied(worldTurns[parent], turns[j]));
      const back = applied(worldTurns[j], ...at[j]);
      const turn = multiplied(camera.rotation, worldTurns[j]);
      const shift = applied(camera.rotation, ...worldJoints[j].map((v, c) => v - back[c]));
      for (let r = 0; r < 3; ++r) {
        for (let c = 0; c < 3; ++c) bones[12 * j + 4 * r + c] = turn[3 * r + c];
        bones[12 * j + 4 * r + 3] = shift[r] + camera.shift[r];
      }
    });
    const m = new Float32Array(12);
    for (let v = 0; v < V; ++v) {
      m.fill(0);
      for (let j = 0; j < 5; ++j) {
        const weight = skinning[5 * v + j];
        if (weight) for (let i = 0; i < 12; ++i) m[i] += weight * bones[12 * j + i];
      }
      const x = vertices[3 * v], y = vertices[3 * v + 1], z = vertices[3 * v + 2];
      vertices[3 * v] = m[0] * x + m[1] * y + m[2] * z + m[3];
      vertices[3 * v + 1] = m[4] * x + m[5] * y + m[6] * z + m[7];
      vertices[3 * v + 2] = m[8] * x + m[9] * y + m[10] * z + m[11];
    }
    this.blend.set(codes, 1);
    this.blend[0] = 1;
  }

  // Writes the splats in view; returns how many.
  project({rotation, shift, focal, size}) {
    const {N, K, vertices, corners, weights, gradient, maps, blends, opacities, colours, blend,
           splats, boxes, depths, visible} = this;
    const eye = applied([rotation[0], rotation[3], rotation[6], rotation[1], rotation[4],
                         rotation[7], rotation[2], rotation[5], rotation[8]], ...shift);
    const far = -Math.hypot(...eye), [dx, dy, dz] = eye.map(value => value / far);
    const seen = [1, dx, dy, dz, dx * dy, dy * dz, dz * dx, dx * dx - dz * dz, dy * dy];
    const limit = 0.65 * size / focal, half = 0.5 * LOG2E, map = new Float32Array(10);
    let count = 0;
    for (let n = 0; n < N; ++n) {
      const opacity = opacities[n];
      if (opacity < OPAQUE) continue;
      for (let i = 0; i < 10; ++i) map[i] = maps[10 * n + i];
      for (let k = 0; k < K; ++k) {
        const weight = blend[k + 1], at = 10 * (k * N + n);
        if (weight) for (let i = 0; i < 10; ++i) map[i] += weight * blends[at + i];
      }
      const a = 3 * corners[3 * n], b = 3 * corners[3 * n + 1], c = 3 * corners[3 * n + 2];
      const ax = vertices[a], ay = vertices[a + 1], az = vertices[a + 2];
      const ux = vertices[b] - ax, uy = vertices[b + 1] - ay, uz = vertices[b + 2] - az;
      const vx = vertices[c] - ax, vy = vertices[c + 1] - ay, vz = vertices[c + 2] - az;
      // Frame of the face: tangent t, bitangent s, normal m.
      const g = gradient[2 * n], h = gradient[2 * n + 1];
      let tx = g * ux + h * vx, ty = g * uy + h * vy, tz = g * uz + h * vz;
      let mx = uy * vz - uz * vy, my = uz * vx - ux * vz, mz = ux * vy - uy * vx;
      const tl = 1 / (Math.sqrt(tx * tx + ty * ty + tz * tz) || 1);
      const ml = 1 / (Math.sqrt(mx * mx + my * my + mz * mz) || 1);
      tx *= tl; ty *= tl; tz *= tl; mx *= ml; my *= ml; mz *= ml;
      if (!g && !h) {  // the head's own axes
        tx = rotation[0]; ty = rotation[3]; tz = rotation[6];
        mx = rotation[2]; my = rotation[5]; mz = rotation[8];
      }
      const sx = my * tz - mz * ty, sy = mz * tx - mx * tz, sz = mx * ty - my * tx;
      const wb = weights[2 * n], wc = weights[2 * n + 1];
      const px = ax + wb * ux + wc * vx + tx * map[0] + sx * map[1] + mx * map[2];
      const py = ay + wb * uy + wc * vy + ty * map[0] + sy * map[1] + my * map[2];
      const pz = az + wb * uz + wc * vz + tz * map[0] + sz * map[1] + mz * map[2];
      if (pz < 0.01) continue;
      // Columns of the quaternion's matrix, as long as the Gaussian's axes, seen by the camera.
      let qw = map[3], qx = map[4], qy = map[5], qz = map[6];
      const ql = 1 / (Math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz) || 1);
      qw *= ql; qx *= ql; qy *= ql; qz *= ql;
      const scale = focal / pz;
      const rx = Math.max(-limit, Math.min(limit, px / pz));
      const ry = Math.max(-limit, Math.min(limit, py / pz));
      // Rows of the projection along tangent, bitangent and normal.
      const ut = scale * (tx - rx * tz), us = scale * (sx - rx * sz), um = scale * (mx - rx * mz);
      const wt = scale * (ty - ry * tz), ws = scale * (sy - ry * sz), wm = scale * (my - ry * mz);
      let xx = 0.3, xy = 0, yy = 0.3;
      for (let k = 0; k < 3; ++k) {
        const s = Math.max(map[7 + k], 1e-4);
        const c0 = k === 0 ? 1 - 2 * (qy * qy + qz * qz) : k === 1 ? 2 * (qx * qy - qw * qz) : 2 * (qx * qz + qw * qy);
        const c1 = k === 0 ? 2 * (qx * qy + qw * qz) : k === 1 ? 1 - 2 * (qx * qx + qz * qz) : 2 * (qy * qz - qw * qx);
        const c2 = k === 0 ? 2 * (qx * qz - qw * qy) : k === 1 ? 2 * (qy * qz + qw * qx) : 1 - 2 * (qx * qx + qy * qy);
        const u = s * (ut * c0 + us * c1 + um * c2), w = s * (wt * c0 + ws * c1 + wm * c2);
        xx += u * u; xy += u * w; yy += w * w;
      }
      const x = focal * px / pz + size / 2, y = focal * py / pz + size / 2;
      const level = Math.log2(255 * opacity);
      const reachX = Math.sqrt(2 / LOG2E * level * xx), reachY = Math.sqrt(2 / LOG2E * level * yy);
      const x0 = Math.max(0, Math.ceil(x - reachX - 0.5)), x1 = Math.min(size, Math.floor(x + reachX + 0.5));
      const y0 = Math.max(0, Math.ceil(y - reachY - 0.5)), y1 = Math.min(size, Math.floor(y + reachY + 0.5));
      if (x0 >= x1 || y0 >= y1) continue;
      const det = xx * yy - xy * xy, l11 = Math.sqrt(half * yy / det), at = 10 * count;
      splats[at] = x; splats[at + 1] = y;
      splats[at + 2] = l11; splats[at + 3] = -half * xy / det / l11;
      splats[at + 4] = Math.sqrt(half / yy);
      splats[at + 5] = opacity; splats[at + 6] = level;
      for (let i = 0; i < 3; ++i) {
        let value = 0;
        for (let k = 0; k < 9; ++k) value += seen[k] * colours[3 * (k * N + n) + i];
        splats[at + 7 + i] = 255 * Math.max(0, Math.min(1, value));
      }
      const box = 4 * count;
      boxes[box] = x0; boxes[box + 1] = y0; boxes[box + 2] = x1; boxes[box + 3] = y1;
      depths[count++] = pz;
    }
    return count;
  }

  sort(count) {  // near to far, by counting 16 bits of depth
    const {depths, keys, counts, order} = this;
    let near = Infinity, far = 0;
    for (let i = 0; i < count; ++i) {
      near = Math.min(near, depths[i]);
      far = Math.max(far, depths[i]);
    }
    const scale = 65535 / Math.max(far - near, 1e-6);
    counts.fill(0);
    for (let i = 0; i < count; ++i) {
      keys[i] = (depths[i] - near) * scale;
      ++counts[keys[i] + 1];
    }
    for (let i = 1; i < counts.length; ++i) counts[i] += counts[i - 1];
    for (let i = 0; i < count; ++i) order[counts[keys[i]]++] = i;
  }

  // Returns RGBA bytes, colours not multiplied by alpha.
  rasterize(count, size, target) {
    const {splats, boxes, order} = this, pixels = size * size;
    if (!this.light || this.light.length !== pixels) {
      this.light = new Float32Array(pixels);  // what still comes through
      this.sums = new Float32Array(4 * pixels);  // three colours; a fourth place keeps pixels aligned
      this.tiles = Math.ceil(size / TILE);
      this.open = new Int32Array(this.tiles * this.tiles);  // unfinished pixels of each tile
    }
    const {light, sums, tiles, open} = this;
    light.fill(1); sums.fill(0); open.fill(TILE * TILE);
    for (let i = 0; i < count; ++i) {
      const n = order[i], box = 4 * n, at = 10 * n;
      const x0 = boxes[box], y0 = boxes[box + 1], x1 = boxes[box + 2], y1 = boxes[box + 3];
      let live = 0;
      for (let ty = y0 >> SHIFT; ty <= (y1 - 1) >> SHIFT && live <= 0; ++ty)
        for (let tx = x0 >> SHIFT; tx <= (x1 - 1) >> SHIFT; ++tx) live += open[ty * tiles + tx];
      if (live <= 0) continue;
      const x = splats[at], l11 = splats[at + 2], l21 = splats[at + 3], l22 = splats[at + 4];
      const opacity = splats[at + 5], cutoff = splats[at + 6];
      const r = splats[at + 7], g = splats[at + 8], b = splats[at + 9];
      for (let py = y0; py < y1; ++py) {
        const dy = py + 0.5 - splats[at + 1], across = l22 * dy, base = across * across;
        if (base >= cutoff) continue;
        const shear = l21 * dy, middle = x - shear / l11, reach = Math.sqrt(cutoff - base) / l11;
        const first = Math.max(x0, Math.ceil(middle - reach - 0.5));
        const last = Math.min(x1, Math.floor(middle + reach + 0.5));
        let along = l11 * (first + 0.5 - x) + shear;
        for (let p = py * size + first, end = py * size + last; p < end; ++p, along += l11) {
          const before = light[p];
          if (before < OPAQUE) continue;
          let alpha = opacity * POWERS[((along * along + base) * STEPS) | 0];
          if (alpha > 0.99) alpha = 0.99;
          const weight = before * alpha, after = before - weight;
          const q = 4 * p;
          sums[q] += weight * r; sums[q + 1] += weight * g; sums[q + 2] += weight * b;
          light[p] = after;
          if (after < OPAQUE) --open[(py >> SHIFT) * tiles + ((p - py * size) >> SHIFT)];
        }
      }
    }
    for (let p = 0; p < pixels; ++p) {
      const alpha = 1 - light[p];
      if (alpha <= 0) { target[4 * p + 3] = 0; continue; }
      target[4 * p] = sums[4 * p] / alpha;
      target[4 * p + 1] = sums[4 * p + 1] / alpha;
      target[4 * p + 2] = sums[4 * p + 2] / alpha;
      target[4 * p + 3] = light[p] < OPAQUE ? 255 : 255 * alpha;
    }
    return target;
  }
}

if (typeof self !== "undefined" && typeof document === "undefined") {
  let drawer;
  self.onmessage = ({data}) => {
    if (data.avatar) { drawer = new Drawer(data.avatar); return; }
    const began = performance.now(), {size} = data.camera;
    const fits = data.pixels && data.pixels.byteLength === 4 * size * size;
    const target = new Uint8ClampedArray(fits ? data.pixels : 4 * size * size);
    drawer.draw(data.parameters, data.codes, data.camera, target);
    const reply = {pixels: target.buffer, size, number: data.number,
                   seconds: (performance.now() - began) / 1000};
    self.postMessage(reply, [target.buffer]);
  };
}
