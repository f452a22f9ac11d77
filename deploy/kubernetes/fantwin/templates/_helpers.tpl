{{- /* What the names of all objects begin with. */}}
{{- define "fantwin.fullname" -}}
{{- $name := empty .Values.nameOverride | ternary .Release.Name (printf "%s-%s" .Release.Name .Values.nameOverride) }}
{{- .Values.fullnameOverride | default $name }}
{{- end }}

{{- define "fantwin.labels" -}}
app.kubernetes.io/name: {{ default .Chart.Name .Values.nameOverride }}
app.kubernetes.io/part-of: fantwin
app.kubernetes.io/instance: {{ .Release.Name }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .Chart.Name .Chart.Version }}
{{- end }}

{{- /* What selects the pods of one part: (dict "root" $ "part" "scorer") */}}
{{- define "fantwin.selector" -}}
app.kubernetes.io/name: {{ default .root.Chart.Name .root.Values.nameOverride }}
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .part }}
{{- end }}

{{- /* The name of one part; names in Kubernetes have no underscores. */}}
{{- define "fantwin.name" -}}
{{ printf "%s-%s" (include "fantwin.fullname" .root) (.part | replace "_" "-") | trunc 52 | trimSuffix "-" }}
{{- end }}

{{- /* The name of the set of a stage. The number of shards is in it: where that changes, every pod gets other trays. So a
new set takes the place of the old one; a rolling update would wait for pods that the old ones keep from starting. */}}
{{- define "fantwin.set" -}}
{{ printf "%s-%s" (include "fantwin.fullname" .root) (.part | replace "_" "-") | trunc 44 | trimSuffix "-" }}-of-{{ .shards }}
{{- end }}

{{- define "fantwin.image" -}}
{{ .Values.image.repository }}:{{ .Values.image.tag | default .Chart.AppVersion }}
{{- end }}

{{- define "fantwin.endpoint" -}}
{{- $scheme := empty .Values.certificates.secret | ternary "tcp" "tls" }}
{{- if not (or .Values.certificates.secret .Values.insecure) }}
{{- fail "certificates.secret: name the Secret with the site's certificates, or accept a bus open to all with insecure=true" }}
{{- end }}
{{- .Values.router.endpoint | default (printf "%s/%s:7447" $scheme (include "fantwin.name" (dict "root" . "part" "router"))) }}
{{- end }}

{{- define "fantwin.security" -}}
- --set=bus.security.folder=/etc/fantwin/certs
{{- end }}

{{- /* The certificate of one role, and no other: (dict "root" $ "role" "scorer") */}}
{{- define "fantwin.certificates" -}}
- name: certificates
  secret:
    secretName: {{ .root.Values.certificates.secret }}
    defaultMode: 0440  # of root, readable by the group of the pod
    items:
      - {key: ca.pem, path: ca.pem}
      - {key: {{ .role }}.pem, path: {{ .role }}.pem}
      - {key: {{ .role }}.key, path: {{ .role }}.key}
{{- end }}

{{- define "fantwin.podSecurity" -}}
automountServiceAccountToken: false
{{- with .Values.serviceAccount.name }}
serviceAccountName: {{ . }}
{{- end }}
{{- with .Values.tolerations }}
tolerations: {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .Values.affinity }}
affinity: {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .Values.image.pullSecrets }}
imagePullSecrets: {{- toYaml . | nindent 2 }}
{{- end }}
securityContext:
  runAsNonRoot: true
  runAsUser: 1000
  runAsGroup: 1000
  fsGroup: 1000
  seccompProfile: {type: RuntimeDefault}
{{- end }}

{{- define "fantwin.containerSecurity" -}}
securityContext:
  allowPrivilegeEscalation: false
  readOnlyRootFilesystem: true
  capabilities: {drop: [ALL]}
{{- end }}
