// The field in a headset, where the browser has WebXR: one drawing an eye, of as many pixels as the time allows.

const FRAME = 9;  // milliseconds for both eyes
const ARM = 1.5;  // metres at which what is usually looked at appears, where the scale is not known

async function startVr(page) {
  const button = $('vr');
  if (!navigator.xr || !await navigator.xr.isSessionSupported('immersive-vr').catch(() => false)) return;
  button.hidden = false;
  button.onclick = () => enterVr(page).catch(error => brief(`The headset cannot show it (${error.message}).`));
}

async function enterVr(page) {
  const {field, about} = page, {gl} = field, session = await navigator.xr.requestSession('immersive-vr');
  await gl.makeXRCompatible();
  const layer = new XRWebGLLayer(session, gl, {antialias: false, depth: false, stencil: false});
  await session.updateRenderState({baseLayer: layer});
  const space = await session.requestReferenceSpace('local');
  // The headset's axes (right, up, back) in the working frame: level, in the direction in which the visitor looked.
  const {turn: [right, down, forward], place} = page.walker.pose, level = v => unit([v[0], v[1], 0]);
  const ahead = Math.abs(forward[2]) < STEEP ? level(forward) : level(times(down, -Math.sign(forward[2])));
  const axes = [cross(ahead, UP), UP, times(ahead, -1)], metre = about.metric ? about.frame.scale : about.depth / ARM;
  const inWorking = v => axes.reduce((sum, axis, i) => plus(sum, axis, v[i]), [0, 0, 0]);
  page.stop();
  page.away = true;
  session.onend = () => {
    page.away = false;
    page.fit();
  };
  const draw = (time, frame) => {
    session.requestAnimationFrame(draw);
    const pose = frame.getViewerPose(space);
    if (!pose) return;
    for (const eye of pose.views) {
      const {x, y, width, height} = layer.getViewport(eye), m = eye.transform.matrix, p = eye.projectionMatrix;
      const part = SIZES.find(size => size * size * width * height * page.perPixel * pose.views.length <= FRAME) || SIZES[SIZES.length - 1];
      const target = field.target(Math.max(1, Math.round(width * part)), Math.max(1, Math.round(height * part)));
      const [w, h] = [target.width, target.height];
      page.draw(target, 0, h, {
        ...page.view(w, h),
        turn: [inWorking(m.slice(0, 3)), inWorking(m.slice(4, 7).map(v => -v)), inWorking(m.slice(8, 11).map(v => -v))].flat(),
        place: plus(place, inWorking(m.slice(12, 15)), metre),
        lens: [p[0] * w / 2, p[5] * h / 2, (1 - p[8]) * w / 2, (1 + p[9]) * h / 2],
      });
      field.put(target, {decoded: layer.framebuffer, x, y, width, height});
    }
  };
  session.requestAnimationFrame(draw);
}
