/** three.js' standard material, taught to take roughness and metallic from vertices, as the asset's mesh holds them, and to mark a selection. */

import { MeshStandardMaterial } from 'three';

/** Of selected parts, as GLSL: a blue that few captured things have. */
const HIGHLIGHT = 'vec3(0.1, 0.65, 1.0)';

export interface HighlightUniforms {
  /** Strength 0..1 of the selection's colour. */
  highlight: { value: number };
  /** 1: nothing else is drawn. */
  onlyHighlight: { value: 0 | 1 };
}

/** Reads the vertex attributes `color` (linear albedo), `_roughness`, `_metallic`, and `_weight` (0..1, how much a vertex is selected). */
export function makeVertexMaterial(uniforms: HighlightUniforms): MeshStandardMaterial {
  const material = new MeshStandardMaterial({ roughness: 1, metalness: 1, vertexColors: true });
  material.polygonOffset = true; // edges that lie in the surface win
  material.polygonOffsetFactor = material.polygonOffsetUnits = 1;
  material.onBeforeCompile = (shader) => {
    Object.assign(shader.uniforms, uniforms);
    shader.vertexShader = shader.vertexShader
      .replace('#include <common>', '#include <common>\nattribute float _roughness, _metallic, _weight;\nvarying vec3 vRoughnessMetallicWeight;')
      .replace('#include <begin_vertex>', '#include <begin_vertex>\nvRoughnessMetallicWeight = vec3(_roughness, _metallic, _weight);');
    shader.fragmentShader = shader.fragmentShader
      .replace('#include <common>', '#include <common>\nvarying vec3 vRoughnessMetallicWeight;\nuniform float highlight, onlyHighlight;')
      .replace('#include <roughnessmap_fragment>', 'float roughnessFactor = vRoughnessMetallicWeight.x;')
      .replace('#include <metalnessmap_fragment>', 'float metalnessFactor = vRoughnessMetallicWeight.y;')
      // Colours here are sRGB with premultiplied alpha.
      .replace(
        '#include <dithering_fragment>',
        `float marked = highlight * vRoughnessMetallicWeight.z;
        gl_FragColor = mix(gl_FragColor * (1.0 - onlyHighlight), vec4(${HIGHLIGHT}, 1.0), marked);`,
      );
  };
  return material;
}
