"use strict";
/* Point clouds as octrees: which nodes are drawn within a budget of points, their loading, drawing and picking.
   Nodes are scripts (see viewer/node_files.py), so that a page from the file system can load them too. */
var Subiaco = window.Subiaco || {};
(function () {
  const LOADS = 8, FINEST_PIXELS = 1.3, STEPS = 65536;
  const COLUMNS = [["x", 2], ["y", 2], ["z", 2], ["object", 4], ["change", 1], ["class", 1], ["intensity", 1], ["confidence", 1]];
  const VERTEX = `
    uniform float uSize, uScale, uSelected; uniform int uColour;
    uniform sampler2D uChange, uClass, uRamp; uniform vec2 uHeights; uniform vec3 uSurvey;
    in float aObject; in vec4 aCodes; out vec3 vColour;
    vec4 entry(sampler2D table, float code) { return texelFetch(table, ivec2(int(code + 0.5), 0), 0); }
    void main() {
      vec4 world = modelMatrix * vec4(position + 0.5, 1.0);
      gl_Position = projectionMatrix * viewMatrix * world;
      vec4 change = entry(uChange, aCodes.x), kind = entry(uClass, aCodes.y);
      float height = clamp((world.z - uHeights.x) / uHeights.y, 0.0, 1.0);
      if (uColour == 0) { vColour = change.rgb; }
      else if (uColour == 1) { vColour = kind.rgb; }
      else if (uColour == 2) { vColour = entry(uRamp, 255.0 * height).rgb; }
      else if (uColour == 3) { vColour = vec3(0.1 + 0.9 * aCodes.z / 255.0); }
      else if (uColour == 4) { vColour = entry(uRamp, aCodes.w).rgb; }
      else { vColour = uSurvey; }
      bool chosen = uSelected > 0.0 && abs(aObject - uSelected) < 0.5;
      if (chosen) { vColour = mix(vColour, vec3(1.0), 0.3); }
      gl_PointSize = clamp(uSize * uScale / gl_Position.w, 1.5, 40.0);
      if (change.a < 0.5 || kind.a < 0.5) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); gl_PointSize = 0.0; }
    }`;
  const FRAGMENT = `
    in vec3 vColour; layout(location = 0) out vec4 pixel;
    void main() { vec2 p = gl_PointCoord - 0.5; if (dot(p, p) > 0.25) { discard; } pixel = vec4(vColour, 1.0); }`;

  async function decode(text, count) {
    const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
    const columns = {};
    let at = 0;
    for (const [name, width] of COLUMNS) {
      const values = new Float64Array(count);
      for (let plane = 0, weight = 1; plane < width; plane += 1, weight *= 256, at += count) {
        for (let i = 0; i < count; i += 1) { values[i] += weight * bytes[at + i]; }
      }
      columns[name] = values;
    }
    return columns;
  }

  class Node {
    constructor(name, count, root) {
      this.name = name; this.count = count; this.level = name.length - 1; this.children = [];
      this.size = root / 2 ** this.level; this.corner = new THREE.Vector3();
      for (let i = 1, edge = root / 2; i < name.length; i += 1, edge /= 2) {
        const octant = Number(name[i]);
        this.corner.x += edge * (octant >> 2); this.corner.y += edge * (octant >> 1 & 1); this.corner.z += edge * (octant & 1);
      }
      this.box = new THREE.Box3(this.corner, this.corner.clone().addScalar(this.size));
      this.state = "absent"; this.points = null; this.used = 0;
    }
  }

  class Octree {
    constructor(name, facts, root, grid, uniforms) {
      this.name = name; this.spacing = facts.spacing; this.grid = grid; this.scene = new THREE.Scene();
      this.nodes = new Map(facts.nodes.map(([node, count]) => [node, new Node(node, count, root)]));
      for (const node of this.nodes.values()) {
        const parent = this.nodes.get(node.name.slice(0, -1));
        if (parent) { parent.children.push(node); }
      }
      this.material = new THREE.ShaderMaterial({ vertexShader: VERTEX, fragmentShader: FRAGMENT, glslVersion: THREE.GLSL3, uniforms: uniforms });
      this.visible = [];
    }
    /* Edge of the points of a node [m]: of the finest node drawn in its cube, as points of ancestors mix with them. */
    edge(node) {
      const drawn = node.children.filter((child) => child.drawn);
      if (drawn.length) { return Math.min(...drawn.map((child) => this.edge(child))); }
      return node.children.length ? Math.max(node.size / this.grid, this.spacing) : this.spacing;
    }
    attach(node, columns) {
      const position = new Uint16Array(3 * node.count), codes = new Uint8Array(4 * node.count);
      for (let i = 0; i < node.count; i += 1) {
        position.set([columns.x[i], columns.y[i], columns.z[i]], 3 * i);
        codes.set([columns.change[i], columns["class"][i], columns.intensity[i], columns.confidence[i]], 4 * i);
      }
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
      geometry.setAttribute("aCodes", new THREE.BufferAttribute(codes, 4));
      geometry.setAttribute("aObject", new THREE.BufferAttribute(new Float32Array(columns.object), 1));
      const points = new THREE.Points(geometry, this.material);
      points.scale.setScalar(node.size / STEPS); points.position.copy(node.corner);
      points.frustumCulled = false; points.updateMatrixWorld();
      points.onBeforeRender = () => { this.material.uniforms.uSize.value = node.edge * this.material.uniforms.uFactor.value; this.material.uniformsNeedUpdate = true; };
      node.points = points; node.state = "loaded"; this.scene.add(points);
    }
    release(node) {
      this.scene.remove(node.points); node.points.geometry.dispose(); node.points = null; node.state = "absent";
    }
  }

  /* A queue whose first entry has the highest priority. */
  class Queue {
    constructor() { this.heap = []; }
    get length() { return this.heap.length; }
    push(priority, value) {
      const heap = this.heap; let i = heap.push([priority, value]) - 1;
      while (i > 0 && heap[(i - 1) >> 1][0] < heap[i][0]) { const up = (i - 1) >> 1; [heap[up], heap[i]] = [heap[i], heap[up]]; i = up; }
    }
    pop() {
      const heap = this.heap, first = heap[0][1], last = heap.pop();
      if (heap.length) {
        heap[0] = last;
        for (let i = 0; ;) {
          let best = i;
          for (const child of [2 * i + 1, 2 * i + 2]) { if (child < heap.length && heap[child][0] > heap[best][0]) { best = child; } }
          if (best === i) { break; }
          [heap[best], heap[i]] = [heap[i], heap[best]]; i = best;
        }
      }
      return first;
    }
  }

  class PointScene {
    constructor(data, uniforms, changed) {
      this.octrees = {}; this.uniforms = uniforms; this.changed = changed; this.budget = 2e6; this.tick = 0; this.inFlight = 0; this.missing = 0; this.drawnPoints = 0;
      for (const name of Object.keys(data.clouds)) {
        const own = { ...uniforms, uSize: { value: 1 }, uSurvey: { value: name === "before" ? new THREE.Vector3(0.902, 0.624, 0) : new THREE.Vector3(0.337, 0.706, 0.914) } };
        this.octrees[name] = new Octree(name, data.clouds[name], data.size, data.grid, own);
      }
      this.waiting = new Map();
      window.subiacoNode = (cloud, node, text) => { const done = this.waiting.get(cloud + "/" + node); if (done) { done(text); } };
    }
    /* Choose the nodes to draw: the largest on the screen first, until the budget is spent. */
    update(camera, names, height) {
      const scale = height / (2 * Math.tan(THREE.MathUtils.degToRad(camera.fov) / 2));
      const frustum = new THREE.Frustum().setFromProjectionMatrix(new THREE.Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse));
      const queue = new Queue(), wanted = [];
      let points = 0;
      this.tick += 1; this.uniforms.uScale.value = scale;
      for (const octree of Object.values(this.octrees)) {
        octree.visible.forEach((node) => { node.drawn = false; if (node.points) { node.points.visible = false; } });
        octree.visible = [];
        if (names.includes(octree.name) && octree.nodes.has("r")) { queue.push(Infinity, [octree, octree.nodes.get("r")]); }
      }
      while (queue.length && points < this.budget) {
        const [octree, node] = queue.pop();
        if (!frustum.intersectsBox(node.box) || points + node.count > this.budget && points > 0) { continue; }
        points += node.count; node.used = this.tick;
        if (node.state !== "loaded") { if (node.state === "absent") { wanted.push([octree, node]); } continue; }
        node.drawn = true; node.points.visible = true; octree.visible.push(node);
        for (const child of node.children) {
          const distance = Math.max(child.box.distanceToPoint(camera.position), 0.05 * child.size);
          if (node.size / octree.grid * scale / distance > FINEST_PIXELS) { queue.push(child.size / distance, [octree, child]); }
        }
      }
      for (const octree of Object.values(this.octrees)) { octree.visible.forEach((node) => { node.edge = octree.edge(node); }); }
      this.drawnPoints = Object.values(this.octrees).reduce((sum, octree) => sum + octree.visible.reduce((s, node) => s + node.count, 0), 0);
      wanted.slice(0, Math.max(LOADS - this.inFlight, 0)).forEach(([octree, node]) => this.load(octree, node));
      this.settled = wanted.length === 0 && this.inFlight === 0;
      this.forget();
    }
    load(octree, node) {
      const key = octree.name + "/" + node.name, script = document.createElement("script");
      const finish = () => { this.inFlight -= 1; this.waiting.delete(key); script.remove(); this.changed(); };
      node.state = "loading"; this.inFlight += 1;
      this.waiting.set(key, (text) => decode(text, node.count).then((columns) => { octree.attach(node, columns); }, () => { node.state = "failed"; this.missing += 1; }).then(finish));
      script.src = key + ".js";
      script.onerror = () => { node.state = "failed"; this.missing += 1; finish(); };
      document.head.appendChild(script);
    }
    /* Release the nodes drawn longest ago once twice the budget is loaded, and at least what one view needs. */
    forget() {
      const loaded = [];
      for (const octree of Object.values(this.octrees)) { for (const node of octree.nodes.values()) { if (node.state === "loaded") { loaded.push([octree, node]); } } }
      let points = loaded.reduce((sum, [, node]) => sum + node.count, 0);
      this.loadedPoints = points;
      if (points <= 2 * this.budget) { return; }
      loaded.sort(([, a], [, b]) => a.used - b.used || b.level - a.level);
      for (const [octree, node] of loaded) {
        if (points <= 2 * this.budget || node.used === this.tick) { break; }
        points -= node.count; octree.release(node);
      }
      this.loadedPoints = points;
    }
    /* Return the drawn point nearest to a pixel, among those within some pixels the one nearest to the camera. */
    pick(camera, names, x, y, width, height, within) {
      const matrix = new THREE.Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
      let best = null;
      for (const name of names) {
        const octree = this.octrees[name];
        for (const node of octree.visible) {
          const m = new THREE.Matrix4().multiplyMatrices(matrix, node.points.matrixWorld).elements;
          const p = node.points.geometry.attributes.position.array, codes = node.points.geometry.attributes.aCodes.array;
          for (let i = 0; i < node.count; i += 1) {
            const px = p[3 * i] + 0.5, py = p[3 * i + 1] + 0.5, pz = p[3 * i + 2] + 0.5;
            const w = m[3] * px + m[7] * py + m[11] * pz + m[15];
            if (w <= 0) { continue; }
            const dx = (1 + (m[0] * px + m[4] * py + m[8] * pz + m[12]) / w) * width / 2 - x, dy = (1 - (m[1] * px + m[5] * py + m[9] * pz + m[13]) / w) * height / 2 - y;
            const off = Math.hypot(dx, dy);
            if (off > within || this.hidden && this.hidden(codes[4 * i], codes[4 * i + 1])) { continue; }
            const cost = w * (1 + 0.02 * off);
            if (!best || cost < best.cost) {
              const step = node.size / STEPS;
              best = { cost: cost, survey: name, object: node.points.geometry.attributes.aObject.array[i] - 1, change: codes[4 * i], kind: codes[4 * i + 1], intensity: codes[4 * i + 2], confidence: codes[4 * i + 3] / 255,
                at: [node.corner.x + px * step, node.corner.y + py * step, node.corner.z + pz * step] };
            }
          }
        }
      }
      return best;
    }
  }
  Subiaco.PointScene = PointScene;
  Subiaco.decode = decode;
}());
window.Subiaco = Subiaco;
