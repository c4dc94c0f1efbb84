// Meshes that turn: each panel has one canvas, side by side what it compares. Without WebGL its picture stays.
const shapes = (() => {
  const VERTEX = `
    attribute vec3 position, normal;
    uniform mat3 turn;
    uniform vec2 scale;
    varying vec3 n;
    void main() {
      vec3 p = turn * position;
      n = turn * normal;
      gl_Position = vec4(p.xy * scale, -0.4 * p.z, 1.0);
    }`;
  const FRAGMENT = `
    precision mediump float;
    varying vec3 n;
    void main() {
      vec3 m = normalize(n) * (gl_FrontFacing ? 1.0 : -1.0);
      float key = max(dot(m, vec3(0.36, 0.48, 0.8)), 0.0), sky = 0.5 + 0.5 * m.y;
      vec3 c = (gl_FrontFacing ? vec3(0.80, 0.76, 0.70) : vec3(0.75, 0.35, 0.28)) * (0.18 + 0.22 * sky + 0.62 * key);
      gl_FragColor = vec4(pow(c, vec3(1.0 / 2.2)), 1.0);
    }`;

  function bytes(text) {
    const found = atob(text), out = new Uint8Array(found.length);
    for (let i = 0; i < found.length; i++) out[i] = found.charCodeAt(i);
    return out.buffer;
  }

  // Vertices at the same place share their normal, so that seams do not show.
  function normals(steps, positions, faces) {
    const places = new Map(), place = new Uint32Array(positions.length / 3);
    for (let i = 0; i < place.length; i++) {
      const name = steps[3 * i] + (steps[3 * i + 1] + steps[3 * i + 2] * 65536) * 65536;
      if (!places.has(name)) places.set(name, places.size);
      place[i] = places.get(name);
    }
    const sum = new Float32Array(3 * places.size), out = new Float32Array(positions.length);
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [0, 1, 2].map((k) => positions.subarray(3 * faces[f + k], 3 * faces[f + k] + 3));
      const u = [0, 1, 2].map((k) => b[k] - a[k]), v = [0, 1, 2].map((k) => c[k] - a[k]);
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      for (let k = 0; k < 3; k++) for (let j = 0; j < 3; j++) sum[3 * place[faces[f + k]] + j] += n[j];
    }
    for (let i = 0; i < place.length; i++) {
      const [x, y, z] = sum.subarray(3 * place[i], 3 * place[i] + 3), length = Math.hypot(x, y, z) || 1;
      out.set([x / length, y / length, z / length], 3 * i);
    }
    return out;
  }

  function program(gl) {
    const made = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    return gl.getProgramParameter(made, gl.LINK_STATUS) ? made : null;
  }

  function buffer(gl, target, data) {
    const made = gl.createBuffer();
    gl.bindBuffer(target, made);
    gl.bufferData(target, data, gl.STATIC_DRAW);
    return made;
  }

  function prepare(box) {
    const canvas = box.querySelector("canvas");
    const gl = canvas.getContext("webgl", { antialias: true, alpha: true });
    const made = gl && gl.getExtension("OES_element_index_uint") && program(gl);
    if (!made) return;
    const solids = [...box.querySelectorAll("[data-positions]")].map((of) => {
      const steps = new Uint16Array(bytes(of.dataset.positions)), faces = new Uint32Array(bytes(of.dataset.faces));
      const positions = Float32Array.from(steps, (x) => (2 * x) / 65535 - 1);
      return {
        count: faces.length, faces: buffer(gl, gl.ELEMENT_ARRAY_BUFFER, faces),
        arrays: { position: buffer(gl, gl.ARRAY_BUFFER, positions), normal: buffer(gl, gl.ARRAY_BUFFER, normals(steps, positions, faces)) },
      };
    });
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    let turn = 0.6, tilt = 0.35, zoom = 1, turning = !still, drawn = 0, seen = true;

    function draw() {
      const ratio = Math.min(devicePixelRatio || 1, 2);
      const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
      if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
      const [c, s, d, t] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
      const each = width / solids.length, least = Math.min(each, height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      gl.useProgram(made);
      gl.uniformMatrix3fv(gl.getUniformLocation(made, "turn"), false, [c, -t * s, d * s, 0, d, t, -s, -t * c, d * c]);
      gl.uniform2f(gl.getUniformLocation(made, "scale"), (0.58 * zoom * least) / each, (0.58 * zoom * least) / height);
      solids.forEach((solid, i) => {
        gl.viewport(Math.round(i * each), 0, Math.round(each), height);
        for (const [name, of] of Object.entries(solid.arrays)) {
          const at = gl.getAttribLocation(made, name);
          gl.bindBuffer(gl.ARRAY_BUFFER, of);
          gl.enableVertexAttribArray(at);
          gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 0, 0);
        }
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, solid.faces);
        gl.drawElements(gl.TRIANGLES, solid.count, gl.UNSIGNED_INT, 0);
      });
    }

    function step(now) {
      if (!turning || !seen) return;
      turn += drawn ? Math.min(now - drawn, 100) * 5e-4 : 0;
      drawn = now;
      draw();
      requestAnimationFrame(step);
    }
    function go() {
      drawn = 0;
      requestAnimationFrame(step);
    }

    canvas.addEventListener("pointerdown", (event) => {
      turning = false;
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!canvas.hasPointerCapture(event.pointerId)) return;
      turn += event.movementX * 0.01;
      tilt = Math.max(-1.5, Math.min(1.5, tilt + event.movementY * 0.01));
      draw();
    });
    canvas.addEventListener("dblclick", () => {
      turning = !turning;
      if (turning) go();
    });
    canvas.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: [-0.1, 0, 1], ArrowRight: [0.1, 0, 1], ArrowUp: [0, -0.1, 1], ArrowDown: [0, 0.1, 1], "+": [0, 0, 1.1], "-": [0, 0, 1 / 1.1] }[event.key];
      if (event.key === " ") {
        turning = !turning;
        if (turning) go();
      } else if (by) {
        turning = false;
        [turn, tilt, zoom] = [turn + by[0], Math.max(-1.5, Math.min(1.5, tilt + by[1])), zoom * by[2]];
        draw();
      } else return;
      event.preventDefault();
    });
    canvas.addEventListener("webglcontextlost", () => box.classList.remove("turns"));
    new IntersectionObserver((found) => {
      const before = seen;
      seen = found[found.length - 1].isIntersecting;
      if (seen && !before && turning) go();
    }).observe(canvas);
    new ResizeObserver(draw).observe(canvas);
    box.classList.add("turns");
    draw();
    if (turning) go();
  }

  for (const box of document.querySelectorAll(".shape")) prepare(box);
})();
